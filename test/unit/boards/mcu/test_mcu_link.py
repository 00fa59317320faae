"""The link to the sensor board: lost frames and silence."""

import pytest

from steps import Steps
from serial_communication.link.session import OK
from links import McuLink
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

    def shown(self, key):
        return dict(self.link.session.values())[key]

    def talks(self):
        return self.link.session.talks(self.link.now())

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
    assert watched.shown('frames lost') == 0 and watched.talks()
    assert watched.link.report(watched.steps.port.time)[:2] == (OK, 'open')


@pytest.mark.parametrize('seqs, lost', [
    ((1, 2, 3), 0), ((1, 3), 1), ((1, 11, 12), 9), ((254, 255, 0, 1), 0), ((250, 4), 9),
    ((255, 1), 1), ((200, 0), 55), ((9,), 0)])
def test_lost_frames_are_counted_over_the_modulo(watch, seqs, lost):
    watched = watch()
    watched.give(b''.join(map(status, seqs)))
    assert watched.seqs() == list(seqs) and watched.shown('frames lost') == lost


def test_a_doubled_frame_is_no_gap(watch):
    watched = watch()
    watched.give(status(1) + status(2) * 3 + status(3))
    assert watched.seqs() == [1, 2, 2, 2, 3] and watched.shown('frames lost') == 0


class Timed(Watched):
    """A link with a timeout of 0.2 s, whose time the test sets, in s from its begin."""

    def __init__(self, logger, **options):
        super().__init__(logger, timeout=0.2, **options)
        self.link.now = lambda: self._now
        self._begin = self._now = self.link.session._latest[None].received_at

    def wait(self, end):
        """Return the silences that are reported until then, with the time of each."""
        del self.silences[:]
        found = []
        while self._now < self._begin + end:
            self._now = min(self.link.session.idle(self._now), self._begin + end)
            self.link.session.idle(self._now)
            found += [(kind, seq, pytest.approx(age), pytest.approx(self._now - self._begin))
                      for kind, seq, age in self.silences]
            del self.silences[:]
        return found

    def receive(self, wire):
        frame, = self.link.session.decoder.feed(wire)
        self.link.session.received(frame, self._now)


def test_silence_is_reported_once_a_second_for_each_message_with_its_age(logger):
    """Otherwise the last values of one would look current while another is received."""
    board = Timed(logger)
    assert board.wait(1.5) == [(None, 0, 0.2, 0.2), (None, 0, 1.2, 1.2)] and not board.talks()
    board.receive(status(9))
    found = []
    for tenth in range(20):
        board.receive(mcu.encode(ADC, 10 + tenth))
        found += board.wait(1.6 + tenth / 10)
        assert board.talks()
    assert found == [(mcu.SensorStatus, 9, 0.2, 1.7), (mcu.SensorStatus, 9, 1.2, 2.7)]
    assert board.wait(4.0) == [(mcu.AdcStatus, 29, 0.2, 3.6), (mcu.SensorStatus, 9, 2.2, 3.7)]
    assert not board.talks()
    board.receive(status(30))
    assert board.talks() and board.wait(4.5)[0] == (mcu.SensorStatus, 30, 0.2, 4.2)
