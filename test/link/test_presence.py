"""What is said of a board that stops sending and starts again, of a link on the wrong port or with
a wrong baud rate, of the heartbeat's priority, and of a lost port."""
import logging
import os
import random

import pytest

from steps import Steps
from serial_communication.boards.bus.link import BusLink
from serial_communication.boards.arduino.heartbeat import HeartbeatThread
from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.boards.arduino.calibration import Calibration
from serial_communication.framing.stream import FRAMING, invalid_frame
from serial_communication.link.link import ERROR, OK, WARN
from serial_communication.boards.mcu.link import McuLink
from serial_communication.link.presence import Presence
from serial_communication.link.sparing_log import SparingLog
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu

NO_FRAME = ('no valid frame: wrong baud rate or board? end the bridge and run '
            '`rosrun serial_communication ports`')
UNKNOWN = ('messages come, but of unknown types: no row of the parameters, and none that the board '
           'announces, has them')
STATUS = mcu.encode(mcu.SensorStatus(400, 500, 1.0, 2.0, 3.0), 7)
TICKS = arduino.encode(arduino.Ticks(3)) + arduino.encode(arduino.SteeringAngle(500))
# What a UART may make of frames at a wrong baud rate.
GARBAGE = bytes.fromhex('e6 80 f8 9e 66 78 fe 98 80 e6 18 f8')
STEP = 0.5      # s


@pytest.fixture
def said(lines):
    """Returns the lines so far that have "the board" in them, without the link's name."""
    def find():
        return [line.split(': ', 1)[1] for line in lines('', logging.INFO)
                if 'the board' in line]
    return find


@pytest.fixture
def presence(logger):
    return Presence(SparingLog('mcu', logger), 'another port')


def test_each_change_is_logged_once(presence, said):
    for at, talks in enumerate((None, True, True, False, False, None, True)):
        presence.log(talks, 'the board is silent', float(at))
    assert said() == ['ready: the board talks', 'the board is silent',
                      'the board is back, it was silent for 3 s']


def test_frequent_changes_are_logged_sparingly_and_the_last_state_is_logged(presence, said):
    changes = 1000
    for at in range(changes):
        presence.log(at % 2 == 0, 'the board is silent', at * STEP)
    # In 10 s one line that it is silent, and one that it is back.
    assert 10 < len(said()) <= 5 + 2 * changes * STEP / 10
    for late in range(0, 40):
        presence.log(False, 'the board is silent', (changes + late) * STEP)
    assert said()[-1] == 'the board is silent'


SILENT = 'the board is silent; check its power, its wiring and the baud rate (115200)'


def send(steps, data, seconds=8.0):
    """The board sends these bytes again and again."""
    for _ in range(int(seconds / 0.2)):
        steps.give(data, 0.2)
    return steps


def test_a_car_that_talks_falls_silent_and_is_back_is_logged(logger, said):
    car = send(Steps(ArduinoLink, logger=logger).run(0.1), TICKS, 1.0)
    assert said() == ['ready: the board talks']
    assert car.link.condition(car.port.time) == (OK, 'open')
    car.run(5.0)
    assert said()[1:] == [SILENT]
    assert car.link.condition(car.port.time) == (WARN, 'open, the board is silent')
    send(car, TICKS, 1.0)
    assert said()[2].startswith('the board is back, it was silent for ')


def test_a_car_that_calibrates_does_not_count_as_silent():
    car = send(Steps(ArduinoLink).run(0.1), TICKS, 1.0).run(10.0)
    assert car.link.talks(car.port.time) is False
    car.link.output.calibration = Calibration(900.0, car.port.time)
    assert car.link.talks(car.port.time) is None


def test_silence_from_the_beginning_is_logged_after_the_startup_time(logger, said):
    sensors = Steps(McuLink, logger=logger).run(1.0)
    assert said() == []
    sensors.run(9.0)
    assert said() == [SILENT]
    send(sensors, STATUS, 1.0)
    assert said()[1:] == ['ready: the board talks']


@pytest.mark.parametrize('granted', [True, False])
def test_the_words_on_the_heartbeats_priority(monkeypatch, granted):
    def schedule(*_arguments):
        if not granted:
            raise PermissionError
    monkeypatch.setattr(os, 'sched_setscheduler', schedule)
    thread = HeartbeatThread('heartbeat', 100.0, lambda due: due, lambda text: None, lambda: 0.0)
    said = thread.start()
    thread.stop(1.0)
    assert said.startswith('the heartbeat has real-time priority' if granted else
                           'no real-time priority for the heartbeat')
    assert ('rtprio' in said) == (not granted)


def test_a_lost_port_is_logged_in_order_and_sparingly(logger, lines):
    sensors = Steps(McuLink, logger=logger).run(0.1).unplug().run(1.0)
    first, second = lines()
    assert 'opening it again when it returns' in first and 'waiting for it' in second
    sensors.plug().unplug().plug()
    assert sensors.link.connection.reconnects == 2 and len(lines()) == 2


def test_a_port_lost_while_the_bridge_ends_is_not_logged(logger, lines):
    sensors = Steps(McuLink, logger=logger).run(0.1).unplug()
    sensors.link.stop()
    sensors.run(2.0)
    assert not lines()


# -- what comes instead of the board's frames -----------------------------------------------------

def test_bytes_without_a_valid_frame_are_reported_after_5_s(presence, lines):
    words = []
    for at in range(24):
        now = at * STEP
        if at < 14:
            presence.bytes_came(now)
        presence.log(False, 'the board is silent', now)
        words.append(presence.meaning(now))
    assert words == [''] * 10 + [NO_FRAME] * 10 + [''] * 4, 'until nothing comes for 3 s'
    assert lines() == [f'mcu: {NO_FRAME}', 'mcu: the board is silent']
    presence.bytes_came(100.0)
    presence.understood(104.0)
    presence.bytes_came(108.0)
    assert presence.meaning(108.9) == ''
    presence.bytes_came(110.0)
    assert presence.meaning(113.0) == NO_FRAME


def test_a_board_that_only_announces_is_silent(presence, lines):
    presence.bytes_came(1.0)
    presence.understood(1.0)
    presence.log(False, 'the board is silent', 1.5)
    assert lines() == ['mcu: the board is silent']


@pytest.mark.parametrize('kind, level, data', [
    (McuLink, WARN, GARBAGE), (McuLink, WARN, TICKS), (ArduinoLink, WARN, STATUS),
    (BusLink, ERROR, STATUS)])
def test_a_wrong_board_or_baud_rate_is_a_line_and_a_condition(kind, level, data, logger, lines):
    steps = send(Steps(kind, logger=logger).run(0.1), data)
    words = NO_FRAME if kind is BusLink else f'open, {NO_FRAME}'
    assert lines(NO_FRAME) == [f'{steps.link.name}: {NO_FRAME}']
    assert steps.link.condition(steps.port.time) == (level, words)
    assert dict(steps.link.report(steps.port.time).values)['state'] == words


def test_the_words_change_with_what_is_received(logger, lines):
    sensors = Steps(McuLink, logger=logger).run(10.0)
    assert lines('the board is silent')
    send(sensors, TICKS)
    assert lines(NO_FRAME)
    send(sensors, STATUS, 4.0)
    assert lines('ready: the board talks', logging.INFO)
    assert sensors.link.condition(sensors.port.time) == (OK, 'open')


@pytest.mark.parametrize('kind, data, text, instead', [
    # Serial.println between packets breaks the packet after it.
    (ArduinoLink, b'speed 7\r\n' + TICKS, 'speed 7', 'bridge.log'),
    (ArduinoLink, b'7\r\n' + arduino.encode(arduino.Ticks(3)), '7', 'bridge.log'),
    (ArduinoLink, b'speed 7\r\n', 'speed 7', 'bridge.log'),
    (ArduinoLink, 'it is 21 °C in here\n'.encode() + TICKS, 'it is 21 °C in here', 'bridge.log'),
    (McuLink, STATUS + b'distance: 7\n', 'distance: 7', 'another port'),
    (McuLink, b'a text of any length, without an end ', 'a text of any length', 'another port'),
    (BusLink, b'pump on\r\n', 'pump on', 'another port')])
def test_a_sketch_that_prints_text_is_told(kind, data, text, instead, logger, lines):
    steps = send(Steps(kind, logger=logger).run(0.1), data)
    words = f'the sketch prints text to this port: use {instead}'
    assert any(each.startswith(f"{steps.link.name}: {words}: '{text}") for each in lines(words))
    assert words in steps.link.report(steps.port.time).summary
    assert steps.link.decoder.errors['framing'] > 0


def test_a_frame_that_the_opening_cut_is_no_text(logger, lines):
    """An announcement is text; the port may be opened while one of its chunks is sent."""
    car = Steps(ArduinoLink, logger=logger).run(0.1)
    car.give(b"uino/UInt16, layout: '<H', fields: [data]}\nlamp: {type: 33\0" + TICKS)
    assert car.link.frames_received == 2 and car.link.decoder.errors['framing'] == 1
    # Neither is a message with a text, or damage inside a chunk.
    car.give(arduino.encode_raw(77, b'a text of any length, which is a value') + b'\x30' + TICKS)
    assert lines('unknown type') and not lines('prints text')


def test_random_bytes_are_no_text(presence):
    source = random.Random(7)
    noise = (source.getrandbits(8 * 40).to_bytes(40, 'little') for _ in range(100000))
    assert sum(bool(presence.not_understood(invalid_frame(raw, FRAMING, ''), 1.0))
               for raw in noise) <= 10


@pytest.mark.parametrize('kind, data', [
    (ArduinoLink, arduino.encode_raw(40, b'\1\2') + arduino.encode_raw(41, b'')),
    (ArduinoLink, b'\x30\0' + arduino.encode_raw(40, b'\1' * 20)),
    (McuLink, mcu.encode_raw(0x20, 0, b'\1'))])
def test_types_that_nobody_knows_are_not_another_baud_rate(kind, data, logger, lines):
    steps = send(Steps(kind, logger=logger).run(0.1), data)
    assert lines(UNKNOWN) and not lines(NO_FRAME)
    assert steps.link.condition(steps.port.time) == (WARN, f'open, {UNKNOWN}')


@pytest.mark.parametrize('kind, data', [
    (ArduinoLink, arduino.encode_raw(40, b'\1\2')), (McuLink, mcu.encode_raw(0x20, 0, b'\1'))])
def test_types_that_the_board_may_still_announce_are_no_errors(kind, data, logger, lines):
    steps = Steps(kind, logger=logger).run(0.1)
    assert steps.give(data).link.error_count() == 1, 'without announcements'
    steps = Steps(kind, logger=logger)
    steps.link.announcement.on_text = lambda text: None
    send(steps.run(0.2), data, 4.0)
    assert steps.link.error_count() == 0
    assert send(steps, data, 4.0).link.decoder.errors['unknown type'] > 0
