"""A link on the wrong port, or with a wrong baud rate: bytes are received, but no frame."""
import logging
import random
import time
from functools import partial

import pytest

from fake_boards import until
from serial_communication.boards import BOARDS, description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.boards.bus.link import BusLink
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.link import McuLink
from serial_communication.framing.stream import FRAMING, invalid_frame
from serial_communication.link import link as link_module
from serial_communication.link.link import ERROR, RX, WARN
from serial_communication.link.presence import SILENCE
from serial_communication.link.unknown_bytes import OtherBoard, UnknownBytes
from serial_communication.transport.port import Port

SWAPPED = "bytes come, but they are the {}'s: are the two ports swapped?"
OTHER = ('bytes come, but no valid frame of this board: another baud rate (115200 is set), or '
         'another board')
HINT = ' `rosrun serial_communication ports` finds out which board is on which port'
STATUS = mcu.encode(mcu.SensorStatus(400, 500, 1.0, 2.0, 3.0), 7)
TICKS = arduino.encode(arduino.Ticks(3)) + arduino.encode(arduino.SteeringAngle(500))
# What a UART may make of frames at a wrong baud rate.
GARBAGE = bytes.fromhex('e6 80 f8 9e 66 78 fe 98 80 e6 18 f8')


def others(has_port=True):
    return [OtherBoard(name, partial(description(name).decoder, False, {}), has_port)
            for name in BOARDS]


def send(line, data, condition, every=0.02):
    """Send these bytes every `every` s until the condition is true."""
    until(condition, doing=lambda: line.write(data), every=every)


@pytest.fixture(autouse=True)
def started_up(monkeypatch):
    """A function that ends the time in which a board may be silent at first."""
    monkeypatch.setattr(link_module, 'STARTUP_TIME', 1e9)
    return lambda: monkeypatch.setattr(link_module, 'STARTUP_TIME', 0.0)


@pytest.fixture
def link_of(open_link):
    """A function that starts a link that knows the other boards."""
    return lambda kind, **options: open_link(kind, other_boards=others(**options))


@pytest.mark.parametrize('kind, level, data, name, has_port', [
    (McuLink, WARN, TICKS, 'arduino', True), (McuLink, WARN, TICKS, 'arduino', False),
    (ArduinoLink, WARN, STATUS, 'mcu', True), (BusLink, ERROR, STATUS, 'mcu', True)])
def test_frames_of_another_board_are_reported_as_swapped_ports_if_it_has_one(
        line, link_of, lines, started_up, kind, level, data, name, has_port):
    link = link_of(kind, has_port=has_port)
    words = SWAPPED.format(name) if has_port else \
        "bytes come, but they are the arduino's: is this its port?"
    prefix = '' if kind is BusLink else 'open, '
    send(line, data, lambda: link.condition(time.monotonic()) == (level, prefix + words))
    started_up()
    send(line, data, lambda: lines(words))
    assert lines(words) == [f'{link.name}: {words}{HINT}']
    state = dict(link.report(time.monotonic()).values)['state']
    assert state.partition('; heartbeat gap')[0] == prefix + words


def test_bytes_without_any_frame_are_not_reported_as_silence(line, link_of, lines, started_up):
    link = link_of(McuLink)
    send(line, GARBAGE, lambda: link.condition(time.monotonic()) == (WARN, f'open, {OTHER}'))
    started_up()
    send(line, GARBAGE, lambda: lines('bytes come'))
    assert lines('the board is silent') == [] and lines(f'mcu: {OTHER}{HINT}')


def test_frames_of_an_unknown_type_do_not_hide_that_the_bytes_are_anothers(line, link_of):
    link = link_of(McuLink)
    unknown = mcu.encode_raw(0x77, 1, b'')
    send(line, TICKS + unknown + TICKS, lambda:
         link.condition(time.monotonic())[1] == 'open, ' + SWAPPED.format('arduino'))
    assert link.last_frame_at is not None


@pytest.mark.parametrize('kind, data, text, instead', [
    # Serial.println between packets breaks the packet after it.
    (ArduinoLink, b'speed 7\r\n' + TICKS, 'speed 7', 'bridge.log'),
    (ArduinoLink, b'7\r\n' + arduino.encode(arduino.Ticks(3)), '7', 'bridge.log'),
    (ArduinoLink, b'speed 7\r\n', 'speed 7', 'bridge.log'),
    (ArduinoLink, 'it is 21 °C in here\n'.encode() + TICKS, 'it is 21 °C in here', 'bridge.log'),
    (McuLink, STATUS + b'distance: 7\n', 'distance: 7', 'another port'),
    (McuLink, b'a text of any length, without an end ', 'a text of any length', 'another port'),
    (BusLink, b'pump on\r\n', 'pump on', 'another port')])
def test_a_sketch_that_prints_text_is_told(line, link_of, lines, kind, data, text, instead):
    link = link_of(kind)
    words = f'the sketch prints text to this port: use {instead}'
    begin = f"{link.name}: {words}: '{text}"
    for condition in (lambda: any(each.startswith(begin) for each in lines('the sketch prints')),
                      lambda: words in link.report(time.monotonic()).summary):
        send(line, data, condition, every=0.1)      # noise ends after a pause
    assert link.decoder.errors['framing'] > 0 and not lines('another baud rate')


def test_a_frame_that_the_opening_cut_is_no_text(line, link_of, lines):
    """An announcement is text; the port may be opened while one of its chunks is sent."""
    link = link_of(ArduinoLink)
    line.write(b"uino/UInt16, layout: '<H', fields: [data]}\nlamp: {type: 33\0" + TICKS)
    until(lambda: link.frames_received == 2)
    assert link.decoder.errors['framing'] == 1 and not lines('prints text')
    # Neither is a message with a text, or damage inside a chunk.
    line.write(arduino.encode_raw(77, b'a text of any length, which is a value') + b'\x30' + TICKS)
    until(lambda: lines('unknown type') and link.frames_received == 3)
    assert not lines('prints text')


def test_random_bytes_are_no_text():
    unknown = UnknownBytes([])
    source = random.Random(7)
    noise = (source.getrandbits(8 * 40).to_bytes(40, 'little') for _ in range(100000))
    assert sum(bool(unknown.add(invalid_frame(raw, FRAMING, ''), 1.0)) for raw in noise) <= 10


@pytest.mark.parametrize('kind, data, types', [
    (ArduinoLink, arduino.encode_raw(40, b'\1\2') + arduino.encode_raw(41, b''), '40, 41'),
    (ArduinoLink, b'\x30\0' + arduino.encode_raw(40, b'\1' * 20), '40'),
    (McuLink, mcu.encode_raw(0x20, 0, b'\1'), '32')])
def test_types_that_nobody_knows_are_not_another_baud_rate(
        line, link_of, lines, started_up, kind, data, types):
    link = link_of(kind)
    words = (f'messages come, but of unknown types ({types}): no row of the parameters, and none '
             'that the board announces, has them')
    received = [time.monotonic()]
    link.tap = lambda *_: received.append(time.monotonic())
    send(line, data, lambda: link.condition(time.monotonic()) == (WARN, f'open, {words}'))
    started_up()
    send(line, data, lambda: lines(words))
    # On a busy machine there may be such a pause.
    was_silent = max(after - before for before, after in zip(received, received[1:])) > SILENCE
    assert not lines('another baud rate') and (was_silent or not lines('the board is silent'))


@pytest.mark.parametrize('kind, data', [
    (ArduinoLink, arduino.encode_raw(40, b'\1\2')), (McuLink, mcu.encode_raw(0x20, 0, b'\1'))])
def test_a_message_of_unknown_type_does_not_end_the_time_in_which_a_board_may_start(
        line, link_of, lines, monkeypatch, kind, data):
    link = link_of(kind)
    check, checked = link.check, []
    line.write(data)
    until(lambda: link.unknown_bytes.size)
    monkeypatch.setattr(link, 'check', lambda now: (check(now), checked.append(now)))
    until(lambda: len(checked) > 1)
    assert not lines('the board is silent')


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


def test_without_announcements_an_unknown_type_is_an_error_at_once(line, link_of):
    link = link_of(ArduinoLink)
    line.write(arduino.encode_raw(40, b''))
    until(lambda: link.decoder.errors['unknown type'] == 1)


def test_a_few_bytes_of_noise_are_silence(line, link_of):
    link = link_of(McuLink)
    line.write(GARBAGE)
    until(lambda: link.port.bytes_received == len(GARBAGE))
    assert link.condition(time.monotonic()) == (WARN, 'open, the board is silent')


def test_the_words_change_with_what_is_received(line, link_of, lines, started_up):
    link = link_of(McuLink)
    started_up()
    until(lambda: lines('the board is silent'))
    send(line, TICKS, lambda: lines("the arduino's"))
    send(line, STATUS, lambda: lines('ready: the board talks', logging.INFO))
    assert link.unknown_bytes.meaning(time.monotonic()) == ''
    assert link.condition(time.monotonic()) == (0, 'open')


def test_bytes_of_before_a_pause_do_not_count():
    unknown = UnknownBytes(others(), 9600)
    unknown.feed(TICKS * 100, 10.0)
    assert unknown.meaning(13.0) == SWAPPED.format('arduino')
    assert unknown.meaning(13.1) == ''
    unknown.feed(GARBAGE, 14.0)
    assert unknown.meaning(14.0) == ''
    unknown.feed(GARBAGE * 2, 15.0)
    assert unknown.meaning(15.0) == OTHER.replace('115200', '9600')
    unknown.reset()
    assert unknown.meaning(15.0) == ''


def test_other_decoders_read_nothing_while_the_board_talks(line, open_link):
    made = []

    class Counting(mcu.Decoder):
        def feed(self, data, stamp=None):
            made.append(data)
            return super().feed(data, stamp)

    link = open_link(ArduinoLink, other_boards=[OtherBoard('mcu', Counting, True)])
    line.write(TICKS)
    until(lambda: link.frames_received == 2)
    before = list(made)
    for received in range(3, 50):
        line.write(arduino.encode(arduino.Ticks(1)))
        until(lambda received=received: link.frames_received >= received)
    assert made == before


def test_a_decoder_of_another_package_that_raises_does_not_end_the_link(line, open_link, lines):
    class Broken(mcu.Decoder):
        def feed(self, data, stamp=None):
            raise RuntimeError('a fault of another package')

    link = open_link(ArduinoLink, other_boards=[OtherBoard('broken', Broken, True)])
    line.write(GARBAGE)
    until(lambda: lines('a fault of another package'))
    line.write(b'\0' + TICKS)
    until(lambda: link.frames_received == 2)
    assert link.connection.number == 1
