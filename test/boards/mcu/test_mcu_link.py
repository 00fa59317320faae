"""The link to the sensor board over a real tty: lost frames and silence."""
import socket
import time

import pytest

from fake_boards import PATIENCE, until
from serial_communication.link.link import ERROR, OK, WARN
from serial_communication.boards.mcu.link import McuLink
from serial_communication.transport.port import Port
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.layout import Value, message_class


def status(seq, range_1=100):
    return mcu.encode(mcu.SensorStatus(range_1 + seq, 200, 1.0, 2.0, 3.0), seq)


ADC = mcu.AdcStatus(1, 2, 3, 4, 5, 6)


class Watched:
    """A link and what it reports."""

    def __init__(self, link_arguments):
        self.got = []
        self.silences = []
        self.link = McuLink(on_status=lambda *status: self.got.append(status),
                            on_silence=self._silent, **link_arguments)

    def _silent(self, kind, seq, age):
        self.silences.append((kind, seq, age))

    def seqs(self):
        return [seq for _, seq, _ in self.got]


@pytest.fixture
def watch(line, logger, running):
    def start(timeout=20.0, **arguments):
        watched = Watched(dict(port=Port(line.path), timeout=timeout, logger=logger, **arguments))
        running(watched.link)
        until(lambda: watched.link.port.is_open)
        return watched
    return start


def test_frames_are_passed_on_with_seq_and_stamp(line, watch):
    watched = watch(clock=lambda: 'stamp')
    line.write(status(7) + mcu.encode(ADC, 8))
    until(lambda: len(watched.got) == 2)
    assert watched.got == [(mcu.SensorStatus(107, 200, 1.0, 2.0, 3.0), 7, 'stamp'),
                           (ADC, 8, 'stamp')]
    assert watched.link.frames_lost == 0 and not watched.link.silent
    assert watched.link.report(time.monotonic())[:2] == (OK, 'open')


def test_a_status_counts_only_the_checksum_errors_before_its_frame(line, watch):
    watched = watch()
    counted = []
    watched.link._on_status = lambda message, seq, stamp: counted.append(
        (seq, watched.link.checksum_errors))
    bad = bytearray(status(2))
    bad[-2] ^= 0xFF
    line.write(status(1) + bytes(bad) + status(3) + bytes(bad) + status(4))     # in one read
    until(lambda: len(counted) == 3)
    assert counted == [(1, 0), (3, 1), (4, 2)]
    assert watched.link.decoder.errors['checksum'] == 2


@pytest.mark.parametrize('seqs, lost', [
    ((1, 2, 3), 0), ((1, 3), 1), ((1, 11, 12), 9), ((254, 255, 0, 1), 0), ((250, 4), 9),
    ((255, 1), 1), ((200, 0), 55), ((9,), 0)])
def test_lost_frames_are_counted_over_the_modulo(line, watch, seqs, lost):
    watched = watch()
    line.write(b''.join(map(status, seqs)))
    until(lambda: len(watched.got) == len(seqs))
    assert watched.seqs() == list(seqs) and watched.link.frames_lost == lost
    assert dict(watched.link.extra_values())['frames lost'] == lost


def test_a_doubled_frame_is_passed_on_once(line, watch):
    watched = watch()
    line.write(status(1) + status(2) * 3 + status(3))
    until(lambda: 3 in watched.seqs())
    assert watched.seqs() == [1, 2, 3]
    assert (watched.link.duplicates, watched.link.frames_lost) == (2, 0)


def test_a_board_that_sends_the_same_frame_again_is_not_silent(line, watch):
    """The same bytes, but not just after the first: another frame, and none is lost."""
    watched = watch(timeout=1.0)
    begun = time.monotonic()
    while time.monotonic() < begun + 1.3:
        line.write(status(1))
        time.sleep(0.05)
    until(lambda: len(watched.got) >= 10)
    assert set(watched.seqs()) == {1} and watched.silences == []
    assert watched.link.frames_lost == 0


def test_a_missing_message_is_reported_though_another_is_received(line, watch):
    """Otherwise its last values would look current while the other is received."""
    watched = watch(timeout=0.3)
    line.write(status(9))
    seq = 10
    deadline = time.monotonic() + 10
    while len(watched.silences) < 2 and time.monotonic() < deadline:
        line.write(mcu.encode(ADC, seq % 256))
        seq += 1
        time.sleep(0.02)
    assert [(kind, number) for kind, number, _ in watched.silences] == [(mcu.SensorStatus, 9)] * 2
    assert watched.silences[0][2] >= 0.3 and not watched.link.silent


def test_a_damaged_frame_is_a_lost_one_and_is_not_passed_on(line, watch):
    damaged = bytearray(status(2))
    damaged[6] ^= 1
    watched = watch()
    line.write(status(1) + bytes(damaged) + status(3))
    until(lambda: len(watched.got) == 2)
    assert watched.seqs() == [1, 3] and watched.link.frames_lost == 1
    assert watched.link.decoder.errors['checksum'] == 1


def test_the_seq_of_an_unknown_type_counts_but_its_frame_is_not_passed_on(line, watch):
    watched = watch()
    line.write(status(1) + mcu.encode_raw(0x77, 2, b'?') + status(3))
    until(lambda: len(watched.got) == 2)
    assert watched.seqs() == [1, 3] and watched.link.frames_lost == 0
    assert watched.link.decoder.errors['unknown type'] == 1


def test_a_custom_message_is_passed_on_and_ends_the_silence(line, watch):
    cliff = message_class('cliff', 0x20, '<H', [Value('range', maximum=2000)])
    watched = watch(messages=[cliff])
    line.write(mcu.encode(cliff(1500), 1))
    until(lambda: watched.got)
    assert [message for message, _, _ in watched.got] == [cliff(1500)] and not watched.link.silent
    line.write(mcu.encode_raw(0x20, 2, b'\1') + mcu.encode_raw(0x20, 3, b'\xff\xff') + status(4))
    until(lambda: len(watched.got) == 2)
    keys = dict(watched.link.report(time.monotonic()).values)
    assert (keys['length errors'], keys['implausible errors'], keys['unknown type errors']) == (
        1, 1, 0)


def test_silence_is_reported_once_a_second_with_its_age(line, watch, lines):
    watched = watch(timeout=0.2)
    last = time.monotonic()
    line.write(status(9) + mcu.encode(ADC, 10))
    until(lambda: len(watched.got) == 2)
    until(lambda: len(watched.silences) >= 6)
    took = time.monotonic() - last
    assert {(kind, seq) for kind, seq, _ in watched.silences} == {
        (mcu.SensorStatus, 9), (mcu.AdcStatus, 10)}
    ages = [age for kind, _, age in watched.silences if kind is mcu.AdcStatus]
    assert 0.2 <= ages[0] < took and ages == sorted(ages) and ages[-1] <= took
    assert ages[2] - ages[0] >= 1.9, 'once a second, not more often'
    assert watched.link.silent and len(lines('the board is silent')) == 1
    assert watched.link.report(time.monotonic()).level == WARN


def test_the_next_frame_ends_the_silence(line, watch):
    watched = watch(timeout=0.15)
    line.write(status(1))
    until(lambda: watched.silences)
    line.write(status(2))
    until(lambda: len(watched.got) == 2)
    assert not watched.link.silent
    count = len(watched.silences)
    until(lambda: len(watched.silences) > count)
    assert watched.silences[-1][1] == 2 and watched.silences[-1][2] < watched.silences[0][2] + 5


def test_noise_does_not_end_a_silence(line, watch):
    watched = watch(timeout=0.2)
    deadline = time.monotonic() + 5
    while not watched.silences and time.monotonic() < deadline:
        line.write(b'\x02\x0c\x10 noise \x03')
        time.sleep(0.01)
    assert watched.silences and watched.got == []


def test_a_board_that_never_sent_is_silent_from_the_start(line, watch):
    watched = watch(timeout=0.1)
    until(lambda: watched.silences)
    assert watched.silences[0][0] is None
    assert watched.link.condition(time.monotonic()) == (WARN, 'open, the board is silent')


def test_silence_is_reported_while_the_port_is_closed_and_ends_with_data(line, watch):
    watched = watch(timeout=0.1)
    line.write(status(200))
    until(lambda: watched.got)
    line.unplug()
    gone = time.monotonic()
    until(lambda: len(watched.silences) >= 4)
    assert time.monotonic() - gone < 4.5, 'once a second, however long the tries are apart'
    assert watched.silences[-1][1] == 200
    assert watched.link.report(time.monotonic()).level == ERROR
    line.plug()
    until(lambda: watched.link.port.is_open)
    line.write(status(3))
    until(lambda: len(watched.got) == 2)
    assert watched.link.frames_lost == 0, 'what a port away lost is not counted'
    assert watched.link.connection.reconnects == 1


def test_an_incomplete_frame_is_dropped_at_a_reconnect(line, watch):
    watched = watch(frame_timeout=20.0)
    line.write(status(1)[:9])
    until(lambda: watched.link.decoder.pending)
    line.unplug()
    until(lambda: not watched.link.port.is_open)
    line.plug()
    until(lambda: watched.link.port.is_open)
    line.write(status(2))
    until(lambda: watched.got)
    assert watched.seqs() == [2] and not any(watched.link.decoder.errors.values())


# -- over a network -------------------------------------------------------------------------------

def test_a_silent_network_port_is_opened_anew(logger, running, lines):
    """A vanished peer sends nothing; a new connection reaches the board again."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        server.settimeout(PATIENCE)
        watched = Watched(dict(port=Port('socket://127.0.0.1:%d' % server.getsockname()[1]),
                               timeout=20.0, logger=logger, network_silence=0.0))
        running(watched.link)
        first, _ = server.accept()
        with first:
            until(lambda: watched.link.port.is_open)
            first.sendall(status(1))
            until(lambda: watched.seqs() == [1])
            # Only for this connection: on a slow machine the next peer may send late.
            watched.link._network_silence = 0.4
            watched.link.wake()
            until(lambda: not watched.link.port.is_open)
            watched.link._network_silence = 0.0
            second, _ = server.accept()
            with second:
                until(lambda: watched.link.port.is_open)
                second.sendall(status(9))
                until(lambda: watched.seqs() == [1, 9])
    assert lines('nothing received from the board for 0.4 s')


def test_only_a_network_port_with_a_limit_is_opened_anew(line, logger, watch):
    watched = watch(network_silence=0.05)
    assert watched.link.check_silence(time.monotonic() + 100, 0.05) is None
    link = McuLink(Port('socket://localhost:1'), logger=logger, network_silence=0.0)
    assert link.check_silence(time.monotonic() + 100, 0.0) is None
