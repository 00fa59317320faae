"""What `wire play` sends: the bytes of a text file, and the whole frames of a bag."""
import time

import pytest
from lines import Line
from waiting import again_if_stalled, until

from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.link import McuLink
from serial_communication.framing.stream import CHECKSUM, FRAMING, OVERSIZE
from serial_communication.tools.wire.play import PiecePlayer, pieces_of
from serial_communication.tools.wire.recording import Read, Recording
from serial_communication.transport.port import Port
from wire_lines import LINKS, as_bag, damaged_reads, decoded, settings

SEEDS = range(20)


@pytest.mark.parametrize('link', LINKS)
def test_a_text_file_is_played_byte_by_byte(link):
    reads = damaged_reads(link, 1)
    pieces, left_out = pieces_of(Recording(0.0, {link: reads}, []), settings(link))
    assert [(piece.at, piece.data) for piece in pieces] == [(read.at, read.data) for read in reads]
    assert left_out == 0


@pytest.mark.parametrize('link', LINKS)
def test_a_bag_plays_its_whole_frames_at_their_times(link):
    """The receiving bridge decodes these frames, and nothing else."""
    line = settings(link)
    damaged = 0
    for seed in SEEDS:
        frames = decoded(damaged_reads(link, seed), line)[0]
        whole = [frame for frame in frames if frame.cause not in (CHECKSUM, FRAMING, OVERSIZE)]
        pieces, left_out = pieces_of(as_bag(damaged_reads(link, seed), line), line)
        assert [piece.at for piece in pieces] == [frame.stamp for frame in whole]
        again = decoded([Read(piece.at, False, piece.data) for piece in pieces], line)[0]
        assert [(frame.raw, frame.cause) for frame in again] == [
            (frame.raw, frame.cause) for frame in whole], seed
        assert left_out == len(frames) - len(whole)
        damaged += left_out
    assert damaged > 5 * len(SEEDS)       # or the test would prove nothing


def test_a_played_recording_has_the_stamps_of_its_own_board_time(tmp_path):
    """The last frame was read 0.4 s late when it was recorded."""
    reads = [Read(0.02 * at, False, mcu.encode(mcu.Time(20_000 * at), 2 * at)
                  + mcu.encode(mcu.AdcStatus(at, 0, 0, 0, 0, 0), 2 * at + 1)) for at in range(80)]
    reads[-1] = reads[-1]._replace(at=reads[-1].at + 0.4)
    pieces, _ = pieces_of(Recording(0.0, {'mcu': reads}, []), settings('mcu'))
    # After a stall the link drops what it receives.
    stamps, read_at = again_if_stalled(lambda: played(tmp_path, pieces, 79))
    assert read_at - stamps[79] > 0.3
    assert stamps[79] - stamps[78] < 0.1


def played(folder, pieces, last):
    """Play to a link; return its stamps by the number of the frame, and when the last frame was
    read; None if the link dropped that one or the one before."""
    line, stamps, read_at = Line(folder / 'near').plug(), {}, []
    link = McuLink(Port(line.near), timeout=60.0, clock=time.monotonic,
                   on_status=lambda message, seq, stamp: stamps.update({message.adc0: stamp}))
    link.tap = lambda name, direction, frame: read_at.append(frame.stamp)
    link.start()
    until(lambda: link.port.is_open)
    port = Port(line.far)
    port.open()
    player = PiecePlayer(port, pieces, -1.0)
    player.start()
    until(lambda: last in stamps or player.ended.is_set() and link.connection.stale)
    player.stop()
    link.stop()
    link.join(10.0)
    port.close()
    line.unplug()
    return (stamps, read_at[-1]) if {last - 1, last} <= set(stamps) else None
