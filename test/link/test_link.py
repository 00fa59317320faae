"""What all links share: the sparing log, counters, reconnecting, threads that end."""
import logging
import os
import threading
import time

import pytest

from fake_boards import PATIENCE, until
from waiting import again_if_stalled
from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.boards.bus.link import BusLink
from serial_communication.boards.mcu.link import McuLink
from serial_communication.transport.port import Port
from serial_communication.link.connection import PortState
from serial_communication.link.link import Link
from serial_communication.link.sparing_log import SparingLog
from serial_communication.link.stall import LONGEST_SLEEP
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus

every_link = pytest.mark.parametrize('kind, names', [
    (BusLink, {'bus link', 'bus opening'}),
    (ArduinoLink, {'arduino link', 'arduino opening', 'arduino heartbeat'}),
    (McuLink, {'mcu link', 'mcu opening'})], ids=('bus', 'arduino', 'mcu'))

# For each link a frame that is valid at any time.
VALID = {BusLink: bus.encode_reply(bus.Reply(bus.SYNC, b'')),
         ArduinoLink: arduino.encode(arduino.Ticks(1)),
         McuLink: mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)}


# -- the log --------------------------------------------------------------------------------------

@pytest.fixture
def log(logger):
    made = SparingLog('bus', logger, clock=lambda: made.time)
    made.time = 0.0
    return made


def test_a_cause_is_logged_once_in_10_s_with_the_number_left_out(log, lines):
    for tenth in range(0, 205):
        log.time = tenth / 10
        log.warn('noise', 'noise again')
    assert lines() == ['bus: noise again', 'bus: noise again (and 99 more like it)',
                       'bus: noise again (and 99 more like it)']


class _Broken(logging.Logger):
    """Raises as rospy's logger does when the terminal is gone."""

    def log(self, *_arguments, **_options):
        raise OSError(5, 'Input/output error')


# -- every link -----------------------------------------------------------------------------------

def threads():
    return {thread.name for thread in threading.enumerate()}


def replug(line, link):
    """Let the port vanish and return; wait until the link has opened it again."""
    before = link.connection.number
    line.unplug()
    until(lambda: not link.port.is_open)
    line.plug()
    until(lambda: link.port.is_open and link.connection.number > before)


def receives(line, link):
    """Wait until the link receives one more valid frame."""
    before = link.frames_received
    until(lambda: link.frames_received > before or line.write(VALID[type(link)]))


@every_link
@pytest.mark.parametrize('present', [True, False], ids=('port open', 'port absent'))
def test_threads_have_names_and_end_within_1_s_of_stop(line, logger, kind, names, present):
    def end_in_time():
        link = kind(Port(line.path if present else line.path + '.absent'), logger=logger)
        assert not names & threads()
        link.start()
        until(lambda: link.connection.number == present and names <= threads())
        begun = time.monotonic()
        link.stop()
        link.join()
        joined = time.monotonic()
        until(lambda: not names & threads())
        ended = time.monotonic()
        assert not link.port.is_open
        assert not present or link.condition(0.0) == (2, 'closed: the bridge is stopping')
        return ended - joined < 1.0 and ended - begun < 1.5
    again_if_stalled(end_in_time)


@every_link
def test_an_absent_port_is_logged_once(line, logger, running, lines, kind, names):
    link = running(kind(Port(line.path + '.absent'), logger=logger))
    until(lines)
    threading.Event().wait(0.5)
    assert len(lines('no such device')) == 1
    report = link.report(time.monotonic())
    assert report.level == 2 and 'no such device' in report.summary


def opening_with(function):
    """A kind of port that calls a function of the test before it is opened."""
    class Opening(Port):
        def open(self):
            function()
            super().open()
    return Opening


def test_an_unexpected_error_of_opening_is_logged_and_opening_is_tried_again(open_link, lines):
    open_link(McuLink, port=opening_with(raising(NotImplementedError)))
    assert lines('NotImplementedError')


@every_link
def test_a_log_that_raises_does_not_end_a_link(line, running, kind, names):
    link = running(kind(Port(line.path), logger=_Broken('broken')))
    until(lambda: link.port.is_open)
    for _ in range(2):
        line.write(b'\x03\x55noise\x00')
        replug(line, link)
    assert names <= threads()


def raising(kind):
    """A function that raises `kind` once, and then does nothing."""
    troubles = [kind]

    def function(*_arguments):
        if troubles:
            raise troubles.pop()('of a test')
    return function


@every_link
@pytest.mark.parametrize('hook', ['opened', 'closed', 'received', 'damaged', 'tick', 'idle'])
def test_an_error_in_a_hook_does_not_end_a_link(
        line, logger, running, monkeypatch, kind, names, hook):
    link = kind(Port(line.path), logger=logger)
    raise_once, original = raising(SystemExit), getattr(link, hook)
    raised = threading.Event()

    def replacement(*arguments):
        try:
            raise_once()
        except BaseException:
            raised.set()
            raise
        return original(*arguments)

    monkeypatch.setattr(link, hook, replacement)
    running(link)
    until(lambda: link.port.is_open or raised.is_set())
    until_raised = {'received': VALID[kind], 'damaged': b'noise\0noise\0'}.get(hook)
    if until_raised:
        until(lambda: raised.is_set() or line.write(until_raised))
    elif hook in ('closed', 'idle'):
        line.unplug()
        until(raised.is_set)
        line.plug()
    until(raised.is_set)
    until(lambda: link.port.is_open)
    receives(line, link)
    assert names <= threads()


def test_heartbeats_go_on_after_one_that_raises(line, logger, running, monkeypatch, lines):
    link = ArduinoLink(Port(line.path), logger=logger)
    original, raise_once = link.heartbeat._work, raising(RuntimeError)
    monkeypatch.setattr(link.heartbeat, '_work', lambda due: raise_once() or original(due))
    running(link)
    until(lambda: link.heartbeats_sent > 20)
    assert lines('of a test')


@every_link
def test_a_tap_that_raises_does_not_disturb_the_link(line, open_link, kind, names):
    link, calls = open_link(kind), []

    def tap(*arguments):
        calls.append(arguments)
        raise RuntimeError('of a test')

    link.tap = tap
    until(lambda: link.frames_received > 3 or line.write(VALID[kind]))
    assert len(calls) > 3 and link.connection.reconnects == 0 and link.port.is_open


def test_while_opening_hangs_idle_is_called_and_the_link_ends_when_it_is_stopped(line, logger):
    free, silences = threading.Event(), []
    link = McuLink(opening_with(free.wait)(line.path), timeout=0.1, logger=logger,
                   on_silence=lambda *status: silences.append(status))
    link.start()
    until(lambda: len(silences) >= 2)
    link.stop()
    link.join(PATIENCE)
    assert 'mcu link' not in threads()
    free.set()
    until(lambda: 'mcu opening' not in threads())
    assert not link.port.is_open, 'the port was opened after the end and left open'


def test_errors_are_counted_reported_and_logged_sparingly(line, open_link, lines):
    link = open_link(McuLink, timeout=20.0)
    valid = mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)
    invalid = valid[:-2] + bytes((valid[-2] ^ 1, 3))
    for _ in range(50):
        line.write(invalid + b'noise')
    line.write(valid)
    until(lambda: link.frames_received)
    report = link.report(time.monotonic())
    values = dict(report.values)
    assert (values['checksum errors'], values['framing errors']) == (50, 50)
    assert (report.level, report.summary) == (1, '100 errors in the last second')
    assert link.report(time.monotonic()).level == 0
    assert len(lines('checksum: ')) == len(lines('framing: ')) == 1
    assert values['bytes received'] == 50 * (len(invalid) + 5) + len(valid)
    assert values['port'] == line.path and float(values['last frame age [s]']) < 20


def test_an_ended_link_leaves_no_file_open(line, logger):
    def descriptors():
        return len(os.listdir('/proc/self/fd'))

    before = None
    for _ in range(3):
        link = McuLink(Port(line.path), logger=logger)
        unopened = descriptors()     # has the port's pipe, which exists from the beginning
        link.start()
        until(lambda: link.port.is_open)
        link.stop()
        link.join(PATIENCE)
        until(lambda: descriptors() <= unopened)
        before = before or unopened
    assert descriptors() <= before + 4


def test_a_false_start_does_not_delay_frames_that_follow_without_a_pause(line, sensor):
    """Its length of 255 would span sixteen frames, and no pause between them is long enough."""
    line.write(bytes((mcu.STX, 255)))
    for seq in range(10):
        if sensor.got:
            break
        threading.Event().wait(0.04)     # less than frame_timeout
        line.write(mcu.encode(mcu.SensorStatus(400, 500, 1.0, 2.0, 3.0), seq))
    until(lambda: sensor.got)
    assert sensor.got[0] == 0 and len(sensor.got) < 10


# -- when `tick` is called ------------------------------------------------------------------------

def scripted(read):
    """A kind of port whose reads return what `read(number of the read)` does, and at once."""
    class Scripted(Port):
        def __init__(self, path):
            super().__init__(path)
            self.timeouts = []      # of the reads

        def read(self, timeout):
            self.timeouts.append(timeout)
            data = read(len(self.timeouts))
            if not data:
                time.sleep(0.001)
            return data
    return Scripted


class _Ticking(Link):
    """Notes, at each call of `tick`, how many reads there were, and the port's state."""

    def __init__(self, port, **arguments):
        super().__init__('ticking', port, mcu.Decoder(), **arguments)
        self.ticks = []

    def tick(self, now):
        self.ticks.append((len(self.port.timeouts), self.connection.state))


class _Draining(_Ticking):
    DRAINS = True


@pytest.mark.parametrize('kind', [_Ticking, _Draining])
def test_tick_is_called_when_it_is_due_and_not_after_each_read(open_link, kind):
    began = time.monotonic()
    link = open_link(kind, port=scripted(lambda number: VALID[McuLink]))
    until(lambda: link.frames_received > 300)
    assert 1 <= len(link.ticks) <= 2 + (time.monotonic() - began) / LONGEST_SLEEP
    assert {state for _, state in link.ticks} == {PortState.RECEIVING}


@pytest.mark.parametrize('kind', [_Ticking, _Draining])
def test_wake_calls_tick_after_the_next_read_although_bytes_are_received_without_end(
        open_link, kind):
    def read(number):
        if link and len(woken) < 2:
            link.wake()      # as a caller in another thread does
            woken.append(number)
        return VALID[McuLink]

    link, woken = None, []
    link = open_link(kind, port=scripted(read))
    until(lambda: len(woken) == 2 and len(link.port.timeouts) > woken[1] + 1)
    assert set(woken) <= {reads for reads, _ in link.ticks}


def test_a_link_that_drains_reads_on_without_waiting_until_nothing_is_left(open_link):
    """An incomplete frame that is given up counts as received, too: delivering it takes time."""
    link = open_link(_Draining, port=scripted(lambda number: (
        VALID[McuLink] if number in (50, 51, 52) else b'noise' if number == 60 else b'')))
    until(lambda: link.decoder.errors['framing'])
    until(lambda reads=len(link.port.timeouts): len(link.port.timeouts) > reads + 3)
    states = dict(link.ticks)
    assert all(states.get(reads, PortState.RECEIVING) is PortState.RECEIVING
               for reads in (50, 51, 52, 60))
    assert states[53] is PortState.DRAINED
    given_up, = (reads for reads, state in states.items()
                 if reads > 60 and state is PortState.RECEIVING)
    assert states[given_up + 1] is PortState.DRAINED
    assert [link.port.timeouts[number] > 0 for number in (49, 50, 51, 52, 53)] == [
        True, False, False, False, True]
