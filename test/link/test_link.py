"""What all links share: the sparing log, counters, and faults that end no link."""
import logging

import pytest

from steps import MemoryPort, Steps
from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.boards.bus.link import BusLink
from serial_communication.boards.mcu.link import McuLink
from serial_communication.link.sparing_log import SparingLog
from serial_communication.link.stall import StallWatch
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus

# For each link a frame that is valid at any time.
VALID = {BusLink: bus.encode_reply(bus.Reply(bus.SYNC, b'')),
         ArduinoLink: arduino.encode(arduino.Ticks(1)),
         McuLink: mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)}
every_link = pytest.mark.parametrize('kind', VALID)


def test_a_cause_is_logged_once_in_10_s_with_the_number_left_out(logger, lines):
    now = [0.0]
    log = SparingLog('bus', logger, clock=lambda: now[0])
    for tenth in range(0, 205):
        now[0] = tenth / 10
        log.warn('noise', 'noise again')
    assert lines() == ['bus: noise again', 'bus: noise again (and 99 more like it)',
                       'bus: noise again (and 99 more like it)']


def test_a_watch_finds_the_stall_of_the_thread_that_stalled_longest():
    watch = StallWatch(0.5, 10.0)
    assert watch.stalled_for(10.5) == 0.0 and not watch.has_just_stalled(10.5)
    assert watch.stalled_for(11.0, 9.0) == 2.0
    assert watch.has_just_stalled(11.49) and not watch.has_just_stalled(11.5)


@every_link
def test_an_absent_port_is_logged_once(kind, logger, lines):
    port = MemoryPort()
    port.is_there = False
    link = Steps(kind, port=port, logger=logger).run(9.0).link
    assert len(lines('no such device')) == 1
    report = link.report(port.time)
    assert report.level == 2 and 'no such device' in report.summary


class _Broken(logging.Logger):
    """Raises as rospy's logger does when the terminal is gone."""

    def log(self, *_arguments, **_options):
        raise OSError(5, 'Input/output error')


def run_on(steps, seconds):
    """Let so much time pass, as the link's threads do, which no error ends."""
    end = steps.port.time + seconds
    while steps.port.time < end:
        try:
            steps.run(end - steps.port.time)
        except OSError:
            steps.port.time += 0.1


@every_link
def test_a_log_that_raises_does_not_end_a_link(kind):
    steps = Steps(kind, logger=_Broken('broken'))
    run_on(steps, 1.0)
    for _ in range(2):
        steps.port.give(b'\x03\x55noise\x00')
        run_on(steps, 1.0)
        steps.port.is_there = False
        run_on(steps, 1.0)
        steps.port.is_there = True
        run_on(steps, 5.0)
    assert steps.port.is_open and steps.link.connection.number >= 3


@every_link
@pytest.mark.parametrize('hook', ['opened', 'closed', 'received', 'damaged', 'tick', 'idle'])
def test_an_error_in_a_hook_does_not_end_a_link(kind, hook, logger, lines, monkeypatch):
    steps, raised = Steps(kind, logger=logger), []
    original = getattr(steps.link, hook)

    def replacement(*arguments):
        if not raised:
            raised.append(hook)
            raise SystemExit('of a test')
        return original(*arguments)

    monkeypatch.setattr(steps.link, hook, replacement)
    steps.run(0.2).give(b'noise\0noise\0', 0.5).give(VALID[kind], 0.5)
    steps.unplug().run(0.5)
    before = steps.plug().link.frames_received
    assert raised and lines('of a test')
    assert steps.give(VALID[kind], 0.5).link.frames_received > before


@every_link
def test_a_tap_that_raises_does_not_disturb_the_link(kind, logger):
    steps, calls = Steps(kind, logger=logger), []

    def tap(*arguments):
        calls.append(arguments)
        raise RuntimeError('of a test')

    steps.link.tap = tap
    steps.run(0.1)
    for _ in range(4):
        steps.give(VALID[kind])
    assert len(calls) > 3 and steps.link.connection.number == 1 and steps.port.is_open


def test_errors_are_counted_reported_and_logged_sparingly(logger, lines):
    steps = Steps(McuLink, timeout=20.0, logger=logger).run(0.1)
    valid = VALID[McuLink]
    invalid = valid[:-2] + bytes((valid[-2] ^ 1, 3))
    steps.give((invalid + b'noise') * 50 + valid)
    link, now = steps.link, steps.port.time
    report = link.report(now)
    values = dict(report.values)
    assert (values['checksum errors'], values['framing errors']) == (50, 50)
    assert (report.level, report.summary) == (1, '100 errors in the last second')
    assert link.report(now).level == 0
    assert len(lines('checksum: ')) == len(lines('framing: ')) == 1
    assert values['bytes received'] == 50 * (len(invalid) + 5) + len(valid)
    assert values['port'] == '/dev/none' and float(values['last frame age [s]']) < 20


def test_a_false_start_does_not_delay_frames_that_follow_without_a_pause(logger):
    """Its length of 255 would span sixteen frames, and no pause between them is long enough."""
    got = []
    steps = Steps(McuLink, logger=logger,
                  on_status=lambda message, seq, stamp: got.append(seq)).run(0.1)
    steps.give(bytes((mcu.STX, 255)))
    for seq in range(10):
        steps.give(mcu.encode(mcu.SensorStatus(400, 500, 1.0, 2.0, 3.0), seq), 0.04)
    assert got[0] == 0 and len(got) >= 5


@every_link
def test_settings_that_another_program_changed_are_told_and_the_link_begins_anew(
        kind, logger, lines):
    steps = Steps(kind, logger=logger).run(0.1)
    steps.port.altered = 'icanon, 9600 baud'
    steps.run(0.2)
    said, = lines('changed the settings of this port')
    assert '(icanon, 9600 baud)' in said and 'They are restored' in said


@pytest.mark.parametrize('kind', ['tty', 'network'])
def test_bytes_that_waited_during_a_stall_are_dropped_and_counted(kind, logger, lines):
    steps = Steps(McuLink, port=MemoryPort(kind), logger=logger).run(0.1)
    frame = VALID[McuLink]
    steps.port.time += 2.0      # no thread runs
    steps.give(frame * 3, 0.4)
    assert steps.link.frames_received == 0
    assert dict(steps.link.report(steps.port.time).values)['stale'] == 3 * len(frame)
    if kind == 'tty':
        steps.run(0.3).give(frame)
        assert steps.link.frames_received == 1
        assert lines(f'{3 * len(frame)} bytes that waited in the port are old and were dropped')
    else:       # any number of old ones may wait in the network
        assert lines('the bridge stalled for 2') and steps.run(1.0).link.connection.number == 2
