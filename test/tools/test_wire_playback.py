"""Bytes and times from a recording: a link decodes them as it did the original."""
import pytest

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing import cobs
from serial_communication.framing.stream import FRAMING
from serial_communication.tools.wire import playback
from serial_communication.tools.wire.playback import Piece
from serial_communication.tools.wire.recording import Read, Recording
from wire_lines import LINKS, as_bag, damaged_reads, decoded, from_board, settings

SEEDS = range(40)


def outcome(reads, line):
    """What must be the same: every frame, except noise, in order, and all error counts.

    How noise is split into frames depends on when the bytes were decoded.
    """
    frames, errors = decoded(reads, line)
    return [(frame.raw, frame.cause) for frame in frames if frame.cause != FRAMING], errors


def play(recording, line, rate=1.0):
    frames = from_board(recording, line)
    return playback.spaced(playback.pieces_of(recording, frames, line), line, rate)


def played(pieces):
    return [Read(piece.at, False, piece.data) for piece in pieces]


@pytest.mark.parametrize('link', LINKS)
def test_a_bag_of_a_damaged_line_plays_back_the_same_frames_and_errors(link):
    line = settings(link)
    damaged = 0
    for seed in SEEDS:
        reads = damaged_reads(link, seed)
        bag = as_bag(reads, line)
        wanted = outcome(reads, line)
        pieces = play(bag, line)
        assert outcome(played(pieces), line) == wanted, seed
        assert playback.differences(from_board(bag, line), pieces, line) == 0
        damaged += sum(wanted[1].values())
    assert damaged > 10 * len(SEEDS)      # or the test would prove nothing


@pytest.mark.parametrize('link', LINKS)
def test_recorded_bytes_play_back_the_same_frames_and_errors(link):
    line = settings(link)
    for seed in SEEDS:
        reads = damaged_reads(link, seed)
        pieces = play(Recording(0.0, {link: reads}, []), line)
        assert b''.join(piece.data for piece in pieces) == b''.join(read.data for read in reads)
        assert outcome(played(pieces), line) == outcome(reads, line), seed


@pytest.mark.parametrize('link', LINKS)
def test_reads_up_to_20_ms_late_decode_the_same(link):
    """Silences differ from the frame timeout by more than that."""
    line = settings(link)
    for seed in SEEDS:
        reads = damaged_reads(link, seed)
        late, last = [], 0.0
        for index, piece in enumerate(play(as_bag(reads, line), line)):
            last = max(last, piece.at + (0.0, 0.02, 0.007)[index % 3])
            late.append(Read(last, False, piece.data))
        assert outcome(late, line) == outcome(reads, line), seed


def test_incomplete_frames_still_time_out_at_another_rate():
    line = settings('mcu')
    for seed in SEEDS:
        reads = damaged_reads('mcu', seed)
        pieces = play(as_bag(reads, line), line, 4.0)
        assert outcome(played(pieces), line)[1] == outcome(reads, line)[1]
        assert pieces[-1].at < reads[-1].at / 2


def test_whole_frames_keep_their_times():
    line = settings('arduino')
    reads = [Read(0.01 * number, False, arduino.encode(arduino.Ticks(number)))
             for number in range(50)]
    pieces = play(as_bag(reads, line), line)
    assert [(piece.at, piece.data) for piece in pieces] == [(read.at, read.data) for read in reads]
    faster = play(as_bag(reads, line), line, 2.0)
    assert [piece.at for piece in faster] == [read.at / 2 for read in reads]


def test_frames_of_one_read_are_sent_in_one_write():
    line = settings('mcu')
    two = [mcu.encode(mcu.SensorStatus(1, 2, 0.0, 0.0, 0.0), seq) for seq in (1, 2)]
    assert play(as_bag([Read(0.5, False, b''.join(two))], line), line) == [
        Piece(0.5, b''.join(two), True)]


def test_a_valid_frame_that_begins_in_an_invalid_one_is_sent_once():
    line = settings('bus')
    ok = bus.encode_reply(bus.Reply(bus.OK))
    stream = b'\xa5\x02\x02' + ok * 2      # a false start that takes the first byte of the next
    bag = as_bag([Read(0.0, False, stream)], line)
    assert sum(len(each.frame.raw) for each in bag.frames) > len(stream)
    assert b''.join(piece.data for piece in play(bag, line)) == stream


def test_a_frame_delayed_by_a_false_start_is_sent_when_it_was_received():
    line = settings('bus')
    ok = bus.encode_reply(bus.Reply(bus.OK))
    reads = [Read(0.0, False, b'\xa5\xc8'), Read(0.02, False, ok), Read(0.04, False, ok)]
    pieces = play(as_bag(reads, line), line)
    assert [piece.at for piece in pieces if piece.data.endswith(ok)] == [0.02, 0.04]
    assert outcome(played(pieces), line) == outcome(reads, line)


def test_only_the_packet_that_is_incomplete_in_a_bag_is_left_out():
    line = settings('arduino')
    reads = [Read(0.0, False, b'\x11' * 400), Read(0.005, False, b'\x11' * 400 + b'\0'),
             Read(0.01, False, arduino.encode(arduino.Ticks(5)))]
    bag = as_bag(reads, line)
    assert [playback.is_complete(frame, line) for frame in from_board(bag, line)] == [False, True]
    assert play(bag, line) == [Piece(0.01, arduino.encode(arduino.Ticks(5)), True)]
    whole = cobs.encode(bytes(arduino.MAX_PACKET + 1)) + b'\0'
    assert play(as_bag([Read(0.0, False, whole)], line), line) == [Piece(0.0, whole, True)]


def test_frames_that_will_differ_are_counted():
    line = settings('mcu')
    frame = mcu.encode_raw(0x20, 1, b'x')
    frames = from_board(as_bag([Read(0.0, False, frame)], line), line)
    assert playback.differences(frames, [Piece(0.0, frame, True)], line) == 0
    assert playback.differences(frames, [Piece(0.0, frame * 2, True)], line) == 1
    assert playback.differences(frames, [Piece(0.0, b'\x11', True)], line) == 1
