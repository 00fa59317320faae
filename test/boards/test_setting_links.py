"""Settings on the links to the model car and the sensor board, over real ttys."""
import math

import pytest

from fake_boards import PATIENCE, Board, CarBoard, until
from serial_communication.boards.arduino import settings as arduino_settings
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.boards.mcu import settings as mcu_settings
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.link import McuLink
from serial_communication.framing.announcement import chunks_of
from serial_communication.framing.settings import SettingMessage, message_of
from serial_communication.transport.port import Port

ROWS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10}}
KP = message_of(arduino_settings(ROWS))
TEXT = b'kp: {setting: 1, layout: "<f", minimum: 0, maximum: 10}\n'


def settings_of(board):
    """The settings that the board has got."""
    return [tuple(message) for message in board.messages(SettingMessage)]


@pytest.fixture
def car(line, running):
    return running(CarBoard(line, [KP]))


@pytest.fixture
def car_link(line, car, logger, running):
    link = running(ArduinoLink(Port(line.path), logger=logger))
    until(lambda: link.heartbeats_sent)
    return link


@pytest.fixture
def sensors(line, running):
    return running(Board(line, mcu.Decoder([KP])))


@pytest.fixture
def sensors_link(line, sensors, logger, running):
    link = running(McuLink(Port(line.path), logger=logger))
    until(lambda: link.port.is_open)
    return link


LINKS = pytest.mark.parametrize('link_name, board_name, read, encode', [
    ('car_link', 'car', arduino_settings, arduino.encode),
    ('sensors_link', 'sensors', mcu_settings, lambda message: mcu.encode(message, 9))])


@LINKS
def test_a_setting_is_sent_until_the_board_reports_it(request, link_name, board_name, read, encode):
    board, link = map(request.getfixturevalue, (board_name, link_name))
    for row in read(ROWS):
        link.board_settings.add(row)
    link.board_settings.want('kp', 2.2)
    until(lambda: settings_of(board)[:2] == [(1, 2.2)] * 2)
    board.write(encode(KP(1, 2.2)))
    until(lambda: link.board_settings.shown()['kp'] == (2.2, 2.2, True))
    count = len(settings_of(board))
    board.write(encode(KP(1, 1.0)))        # it has started again
    until(lambda: len(settings_of(board)) > count)
    assert set(settings_of(board)) == {(1, 2.2)}
    assert dict(link.report(0.0).values)['settings unconfirmed'] == 'kp=2.2'


@LINKS
def test_nothing_is_told_as_confirmed_while_the_port_is_closed(
        request, link_name, board_name, read, encode):
    board, link = map(request.getfixturevalue, (board_name, link_name))
    settings = link.board_settings
    for row in read(ROWS):
        settings.add(row)
    settings.want('kp', 2.0)
    until(lambda: settings_of(board))
    board.write(encode(KP(1, 2.0)))
    until(lambda: settings.shown()['kp'][2])
    with board.unplugged():
        until(lambda: not link.port.is_open)
        until(lambda: settings.shown()['kp'] == (2.0, 2.0, False))
        assert dict(link.report(0.0).values)['settings unconfirmed'] == 'kp=2'
        settings.want('kp', 2.0)        # the same
        assert not settings.shown()['kp'][2]
        board.forget()
    until(lambda: settings_of(board))


@LINKS
def test_an_announced_setting_is_sent_only_to_a_board_that_announces_it(
        request, link_name, board_name, read, encode):
    board, link = map(request.getfixturevalue, (board_name, link_name))
    link.announcement.on_text = lambda text: None
    link.announcement.use(TEXT, '', ['kp'])
    for row in read(ROWS):
        link.board_settings.add(row, announced=True)
    link.board_settings.want('kp', 2.0)
    board.write(encode(KP(1, 5.0)) + encode(chunks_of(b'other: {type: 32}\n', 60)[0]))
    until(lambda: link.announcement.assembly.text is not None)     # another board
    assert link.board_settings.shown()['kp'][0] is None and settings_of(board) == []
    board.write(b''.join(map(encode, chunks_of(TEXT, 40))))
    until(lambda: settings_of(board))


@LINKS
def test_a_board_with_nothing_wanted_gets_nothing_new(request, link_name, board_name, read, encode):
    board, link = map(request.getfixturevalue, (board_name, link_name))
    for row in read(ROWS):
        link.board_settings.add(row)
    for value in (1.0, 2.0, 1.0):
        board.write(encode(KP(1, value)))
        until(lambda value=value: link.board_settings.shown()['kp'][0] == value)
    assert {type(message) for message in board.messages()} <= {
        arduino.SpeedCommand, arduino.Heartbeat}


def test_a_value_that_is_no_number_is_not_used_also_without_check_plausibility(
        line, car, logger, running):
    link = running(ArduinoLink(Port(line.path), ArduinoSettings(check_plausibility=False),
                               logger=logger))
    settings, used = link.board_settings, []
    for row in arduino_settings(ROWS):
        settings.add(row)
    settings.on_change = lambda: used.append(settings.shown()['kp'][0])
    until(lambda: link.heartbeats_sent)
    car.write(arduino.encode(KP(1, math.nan)) + arduino.encode(KP(1, 1.5)))
    until(lambda: used[-1:] == [1.5])
    assert set(used) <= {None, 1.5} and link.decoder.errors['implausible'] == 1


def test_a_setting_waits_until_the_calibration_is_over_and_delays_no_heartbeat(car, car_link):
    for row in arduino_settings(ROWS):
        car_link.board_settings.add(row)
    car_link.calibrate_imu()
    until(lambda: car.messages(arduino.ImuCalibration))
    car_link.board_settings.want('kp', 2.0)
    count = car_link.heartbeats_sent
    until(lambda: car_link.heartbeats_sent > count + 50)
    assert settings_of(car) == []
    car_link.output.calibration = None
    until(lambda: settings_of(car))


def test_a_setting_does_not_leave_before_speed_0_and_not_after_the_end(car, car_link):
    for row in arduino_settings(ROWS):
        car_link.board_settings.add(row)
    with car.unplugged():
        until(lambda: not car_link.port.is_open)
        car_link.board_settings.want('kp', 2.0)
        car.forget()
    until(lambda: settings_of(car))
    assert car.messages()[0] == arduino.SpeedCommand(0)
    car_link.stop()
    until(lambda: car.messages()[-1] == arduino.SpeedCommand(0))
    last = len(car.messages())
    car_link.board_settings.want('kp', 3.0)
    car_link.join(PATIENCE)
    assert len(car.messages()) == last and (1, 3.0) not in settings_of(car)
