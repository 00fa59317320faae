"""The link to the sensor board: lost frames and silence."""
from contextlib import nullcontext

import pytest

from steps import Steps
from serial_communication.framing.layout import Value, message_class
from serial_communication.link.link import ERROR, OK
from serial_communication.boards.mcu.link import McuLink
from serial_communication.transport.port import Port, PortError
from serial_communication.boards.mcu import wire as mcu


def status(seq, range_1=100):
    return mcu.encode(mcu.SensorStatus(range_1 + seq, 200, 1.0, 2.0, 3.0), seq)


ADC = mcu.AdcStatus(1, 2, 3, 4, 5, 6)


class Watched:
    """A link and what it reports."""

    def __init__(self, logger, **options):
        self.got = []
        self.silences = []
        self.steps = Steps(McuLink, on_status=lambda *status: self.got.append(status),
                           on_silence=lambda *silence: self.silences.append(silence),
                           logger=logger, **options)
        self.link = self.steps.link

    def give(self, data):
        self.steps.give(data)

    def seqs(self):
        return [seq for _, seq, _ in self.got]


@pytest.fixture
def watch(logger):
    def start(timeout=20.0, **options):
        watched = Watched(logger, timeout=timeout, **options)
        watched.steps.run(0.1)
        return watched
    return start


def test_frames_are_passed_on_with_seq_and_stamp(watch):
    watched = watch(clock=lambda: 'stamp')
    watched.give(status(7) + mcu.encode(ADC, 8))
    assert watched.got == [(mcu.SensorStatus(107, 200, 1.0, 2.0, 3.0), 7, 'stamp'),
                           (ADC, 8, 'stamp')]
    assert watched.link.frames_lost == 0 and not watched.link.silent
    assert watched.link.report(watched.steps.port.time)[:2] == (OK, 'open')


def test_a_status_counts_only_the_checksum_errors_before_its_frame(watch):
    watched = watch()
    counted = []
    watched.link._on_status = lambda message, seq, stamp: counted.append(
        (seq, watched.link.checksum_errors))
    bad = bytearray(status(2))
    bad[-2] ^= 0xFF
    watched.give(status(1) + bytes(bad) + status(3) + bytes(bad) + status(4))     # in one read
    watched.steps.run(0.2)      # a false start is given up
    assert counted == [(1, 0), (3, 1), (4, 2)]
    assert watched.link.decoder.errors['checksum'] == 2


@pytest.mark.parametrize('seqs, lost', [
    ((1, 2, 3), 0), ((1, 3), 1), ((1, 11, 12), 9), ((254, 255, 0, 1), 0), ((250, 4), 9),
    ((255, 1), 1), ((200, 0), 55), ((9,), 0)])
def test_lost_frames_are_counted_over_the_modulo(watch, seqs, lost):
    watched = watch()
    watched.give(b''.join(map(status, seqs)))
    assert watched.seqs() == list(seqs) and watched.link.frames_lost == lost
    assert dict(watched.link.extra_values())['frames lost'] == lost


def test_a_doubled_frame_is_passed_on_once(watch):
    watched = watch()
    watched.give(status(1) + status(2) * 3 + status(3))
    assert watched.seqs() == [1, 2, 3]
    assert (watched.link.duplicates, watched.link.frames_lost) == (2, 0)


def test_the_seq_of_an_unknown_type_counts_but_its_frame_is_not_passed_on(watch):
    watched = watch()
    watched.give(status(1) + mcu.encode_raw(0x77, 2, b'?') + status(3))
    assert watched.seqs() == [1, 3] and watched.link.frames_lost == 0
    assert watched.link.decoder.errors['unknown type'] == 1


def test_the_seq_of_a_frame_that_is_refused_counts(watch):
    load = message_class('Load', 0x40, '<B', [Value('load', maximum=9)])
    watched = watch(messages=[load])
    watched.give(status(1) + mcu.encode_raw(0x40, 2, b'\x0a') + status(3)
                 + mcu.encode_raw(0x40, 4, b'too long') + status(5) + status(7))
    assert watched.seqs() == [1, 3, 5, 7] and watched.link.frames_lost == 1
    errors = watched.link.decoder.errors
    assert errors['implausible'] == errors['length'] == 1


def test_a_fault_of_a_receiver_is_logged_and_costs_no_connection(watch, lines):
    watched = watch()
    on_status, faults = watched.link._on_status, iter([True])

    def receive(*arguments):
        on_status(*arguments)
        next(faults, False) and 1 / 0
    watched.link._on_status = receive
    watched.give(status(1) + status(2))
    assert watched.link.connection.reconnects == 0 and len(lines('ZeroDivisionError')) == 1


class Timed(Watched):
    """A link with a timeout of 0.2 s, whose time the test sets, in s from its begin."""

    def __init__(self, logger, **options):
        super().__init__(logger, timeout=0.2, **options)
        self._begin = self._now = self.link._latest[None].received_at

    def wait(self, end):
        """Return the silences that are reported until then, with the time of each."""
        del self.silences[:]
        found = []
        while self._now < self._begin + end:
            self._now = min(self.link.idle(self._now), self._begin + end)
            self.link.idle(self._now)
            found += [(kind, seq, pytest.approx(age), pytest.approx(self._now - self._begin))
                      for kind, seq, age in self.silences]
            del self.silences[:]
        return found

    def receive(self, wire):
        frame, = self.link.decoder.feed(wire)
        self.link.received(frame, self._now)


def test_silence_is_reported_once_a_second_for_each_message_with_its_age(logger):
    """Otherwise the last values of one would look current while another is received."""
    board = Timed(logger)
    assert board.wait(1.5) == [(None, 0, 0.2, 0.2), (None, 0, 1.2, 1.2)] and board.link.silent
    board.receive(status(9))
    found = []
    for tenth in range(20):
        board.receive(mcu.encode(ADC, 10 + tenth))
        found += board.wait(1.6 + tenth / 10)
        assert not board.link.silent
    assert found == [(mcu.SensorStatus, 9, 0.2, 1.7), (mcu.SensorStatus, 9, 1.2, 2.7)]
    assert board.wait(4.0) == [(mcu.AdcStatus, 29, 0.2, 3.6), (mcu.SensorStatus, 9, 2.2, 3.7)]
    assert board.link.silent
    board.receive(status(30))
    assert not board.link.silent and board.wait(4.5)[0] == (mcu.SensorStatus, 30, 0.2, 4.2)


def test_a_board_that_has_sent_custom_messages_alone_is_reported_as_well(logger):
    load = message_class('Load', 0x40, '<B', [Value('load')])
    board = Timed(logger, messages=[load])
    assert board.wait(0.3) == [(None, 0, 0.2, 0.2)]
    for seq in range(10):
        board.receive(mcu.encode_raw(0x40, seq, b'1'))
        assert not board.link.silent and board.wait(0.3 + (seq + 1) * 0.1) == []
    assert board.wait(1.6) == [(None, 0, 0.2, 1.4), (load, 9, 0.2, 1.4)] and board.link.silent
    board.receive(status(10))
    assert board.wait(2.0) == [(mcu.SensorStatus, 10, 0.2, 1.8)]


def test_a_board_that_sends_the_same_frame_again_is_not_silent(logger):
    """The same bytes, but not just after the first: another frame, and none is lost."""
    board = Timed(logger)
    for time_ in (0.05, 0.1, 0.15, 0.3, 0.45, 0.6):
        assert board.wait(time_) == []
        board.receive(status(1))
    assert board.seqs() == [1] * 6 and board.link.frames_lost == 0


def test_silence_is_reported_while_the_port_is_closed_and_ends_with_data(watch):
    watched = watch(timeout=0.1)
    watched.give(status(200) + status(201)[:9])
    watched.steps.unplug().run(1.0)
    assert watched.silences[-1][1] == 200
    assert watched.link.report(watched.steps.port.time).level == ERROR
    watched.steps.plug()
    watched.give(status(3))
    assert watched.seqs() == [200, 3] and not any(watched.link.decoder.errors.values())
    assert watched.link.frames_lost == 0, 'what a port away lost is not counted'
    assert watched.link.connection.reconnects == 1


@pytest.mark.parametrize('url, limit, is_lost', [
    ('socket://localhost:1', 0.4, True), ('socket://localhost:1', 0.0, False),
    ('/dev/tty', 0.4, False)])
def test_only_a_silent_network_port_with_a_limit_is_opened_anew(logger, url, limit, is_lost):
    link = McuLink(Port(url), logger=logger, network_silence=limit)
    now = link.connection.last_byte_at
    link.tick(now + 0.39)
    with pytest.raises(PortError, match='nothing received') if is_lost else nullcontext():
        link.tick(now + 0.4)
