"""What is said of a board that stops sending and starts again, of a link on the wrong port or with
a wrong baud rate, of the heartbeat's priority, and of a lost port."""
import logging
import os
import random
import time

import pytest

from fake_boards import CarBoard, until
from serial_communication.boards.bus.link import BusLink
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.boards.arduino.calibration import Calibration
from serial_communication.framing.stream import FRAMING, invalid_frame
from serial_communication.link import link as link_module
from serial_communication.link import presence as presence_module
from serial_communication.link.link import ERROR, RX, SILENCE, WARN
from serial_communication.boards.mcu.link import McuLink
from serial_communication.link.presence import Presence
from serial_communication.link.sparing_log import SparingLog
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.transport.port import Port

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


def test_a_car_that_talks_falls_silent_and_is_back_is_logged(line, running, open_link, said):
    class Car(CarBoard):
        talks = True

        def idle(self):
            if self.talks:
                self.line.write(arduino.encode(arduino.Voltage(12.0)))

    car = running(Car(line))
    link = open_link(ArduinoLink, ArduinoSettings(network_silence=0.0))
    until(lambda: said() == ['ready: the board talks'])
    assert 'silent' not in link.condition(link.last_frame_at)[1]
    car.talks = False
    until(lambda: len(said()) == 2)
    assert 'open, the board is silent' in link.condition(time.monotonic())[1]
    assert said()[1] == ('the board is silent; check its power, its wiring and the baud rate '
                         '(115200)')
    car.talks = True
    until(lambda: len(said()) == 3)
    assert said()[2].startswith('the board is back, it was silent for ')


def test_a_car_that_calibrates_does_not_count_as_silent(line, logger):
    link = ArduinoLink(Port(line.path), logger=logger)
    now = time.monotonic()
    link.last_frame_at = link.connection.opened_at = now
    later = now + 2 * SILENCE
    assert link.talks(later) is False
    link.output.calibration = Calibration(900.0, later)
    assert link.talks(later) is None


def test_silence_from_the_beginning_is_logged_after_the_startup_time(
        line, open_link, said, monkeypatch):
    monkeypatch.setattr(link_module, 'STARTUP_TIME', 0.5)
    began = time.monotonic()
    open_link(McuLink, timeout=0.1)
    until(said)
    assert time.monotonic() >= began + 0.5
    assert said()[0].startswith('the board is silent')
    talk = mcu.encode(mcu.SensorStatus(1, 2, 0.0, 0.0, 0.0), 0)
    until(lambda: line.write(talk) or len(said()) >= 2)
    assert said()[1] == 'ready: the board talks'


@pytest.mark.parametrize('granted', [True, False])
def test_whether_the_heartbeat_has_real_time_priority_is_logged_once(
        open_link, lines, monkeypatch, granted):
    def schedule(*_arguments):
        if not granted:
            raise PermissionError
    monkeypatch.setattr(os, 'sched_setscheduler', schedule)
    open_link(ArduinoLink)
    until(lambda: lines('real-time', logging.INFO))
    said, = lines('real-time', logging.INFO)
    assert said.startswith('arduino: the heartbeat has real-time priority' if granted else
                           'arduino: no real-time priority for the heartbeat')
    assert ('rtprio' in said) == (not granted)


def test_a_port_lost_while_the_bridge_ends_is_not_logged(line, open_link, lines):
    link = open_link(McuLink)
    line.unplug()
    until(lambda: not link.port.is_open)
    link.stop()
    link.join()
    assert not lines()


def test_a_port_lost_at_another_time_is_logged_in_order_and_sparingly(line, open_link, lines):
    link = open_link(McuLink)
    line.unplug()
    until(lambda: len(lines()) == 2)
    assert 'opening it again when it returns' in lines()[0] and 'waiting for it' in lines()[1]
    line.plug()
    until(lambda: link.connection.reconnects)
    before = len(lines())
    line.unplug()
    line.plug()
    until(lambda: link.connection.reconnects == 2)
    assert len(lines()) == before       # the same loss within 10 s is not logged again


# -- what comes instead of the board's frames -----------------------------------------------------

@pytest.fixture
def soon(monkeypatch):
    """No valid frame is reported at once, and no board starts up silently."""
    monkeypatch.setattr(link_module, 'STARTUP_TIME', 0.0)
    monkeypatch.setattr(presence_module, '_NO_FRAME_TIME', 0.1)


def send(line, data, condition, every=0.02):
    """Send these bytes every `every` s until the condition is true."""
    until(condition, doing=lambda: line.write(data), every=every)


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
def test_a_wrong_board_or_baud_rate_is_a_line_and_a_condition(
        line, open_link, lines, soon, kind, level, data):
    link = open_link(kind)
    words = NO_FRAME if kind is BusLink else f'open, {NO_FRAME}'
    send(line, data, lambda: lines(NO_FRAME))
    send(line, data, lambda: link.condition(time.monotonic()) == (level, words))
    assert lines(NO_FRAME) == [f'{link.name}: {NO_FRAME}']
    state = dict(link.report(time.monotonic()).values)['state']
    assert state.partition('; heartbeat gap')[0] == words


def test_the_words_change_with_what_is_received(line, open_link, lines, soon):
    link = open_link(McuLink)
    until(lambda: lines('the board is silent'))
    send(line, TICKS, lambda: lines(NO_FRAME))
    send(line, STATUS, lambda: lines('ready: the board talks', logging.INFO))
    assert link.condition(time.monotonic()) == (0, 'open')


@pytest.mark.parametrize('kind, data, text, instead', [
    # Serial.println between packets breaks the packet after it.
    (ArduinoLink, b'speed 7\r\n' + TICKS, 'speed 7', 'bridge.log'),
    (ArduinoLink, b'7\r\n' + arduino.encode(arduino.Ticks(3)), '7', 'bridge.log'),
    (ArduinoLink, b'speed 7\r\n', 'speed 7', 'bridge.log'),
    (ArduinoLink, 'it is 21 °C in here\n'.encode() + TICKS, 'it is 21 °C in here', 'bridge.log'),
    (McuLink, STATUS + b'distance: 7\n', 'distance: 7', 'another port'),
    (McuLink, b'a text of any length, without an end ', 'a text of any length', 'another port'),
    (BusLink, b'pump on\r\n', 'pump on', 'another port')])
def test_a_sketch_that_prints_text_is_told(
        line, open_link, lines, soon, kind, data, text, instead):
    link = open_link(kind)
    words = f'the sketch prints text to this port: use {instead}'
    begin = f"{link.name}: {words}: '{text}"
    for condition in (lambda: any(each.startswith(begin) for each in lines('the sketch prints')),
                      lambda: words in link.report(time.monotonic()).summary):
        send(line, data, condition, every=0.1)      # noise ends after a pause
    assert link.decoder.errors['framing'] > 0


def test_a_frame_that_the_opening_cut_is_no_text(line, open_link, lines):
    """An announcement is text; the port may be opened while one of its chunks is sent."""
    link = open_link(ArduinoLink)
    line.write(b"uino/UInt16, layout: '<H', fields: [data]}\nlamp: {type: 33\0" + TICKS)
    until(lambda: link.frames_received == 2)
    assert link.decoder.errors['framing'] == 1 and not lines('prints text')
    # Neither is a message with a text, or damage inside a chunk.
    line.write(arduino.encode_raw(77, b'a text of any length, which is a value') + b'\x30' + TICKS)
    until(lambda: lines('unknown type') and link.frames_received == 3)
    assert not lines('prints text')


def test_random_bytes_are_no_text(presence):
    source = random.Random(7)
    noise = (source.getrandbits(8 * 40).to_bytes(40, 'little') for _ in range(100000))
    assert sum(bool(presence.not_understood(invalid_frame(raw, FRAMING, ''), 1.0))
               for raw in noise) <= 10


@pytest.mark.parametrize('kind, data', [
    (ArduinoLink, arduino.encode_raw(40, b'\1\2') + arduino.encode_raw(41, b'')),
    (ArduinoLink, b'\x30\0' + arduino.encode_raw(40, b'\1' * 20)),
    (McuLink, mcu.encode_raw(0x20, 0, b'\1'))])
def test_types_that_nobody_knows_are_not_another_baud_rate(
        line, open_link, lines, soon, kind, data):
    link = open_link(kind)
    send(line, data, lambda: lines(UNKNOWN))
    send(line, data, lambda: link.condition(time.monotonic()) == (WARN, f'open, {UNKNOWN}'))
    assert not lines(NO_FRAME)


@pytest.mark.parametrize('kind, data', [
    (ArduinoLink, arduino.encode_raw(40, b'\1\2')), (McuLink, mcu.encode_raw(0x20, 0, b'\1'))])
def test_types_that_the_board_may_still_announce_are_no_errors(
        line, logger, running, lines, monkeypatch, kind, data):
    monkeypatch.setattr(link_module, '_ANNOUNCING', 1e9)
    link = kind(Port(line.path), logger=logger)
    link.announcement.on_text = lambda text: None
    taken = []
    link.tap = lambda name, direction, frame: direction == RX and taken.append(link.error_count())
    running(link)
    until(lambda: link.port.is_open)
    line.write(data * 3)
    until(lambda: len(taken) == 3)
    assert taken == [0, 0, 0] and not lines('unknown type')
    monkeypatch.setattr(link_module, '_ANNOUNCING', 0.0)
    send(line, data, link.error_count)
    assert link.decoder.errors['unknown type'] == link.error_count()


def test_without_announcements_an_unknown_type_is_an_error_at_once(line, open_link):
    link = open_link(ArduinoLink)
    line.write(arduino.encode_raw(40, b''))
    until(lambda: link.decoder.errors['unknown type'] == 1)
