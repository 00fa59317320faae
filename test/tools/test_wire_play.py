"""What `wire play` sends: the bytes of a text file, and the whole frames of a bag."""
import pytest

from serial_communication.framing.stream import CHECKSUM, FRAMING, OVERSIZE
from serial_communication.tools.wire.play import pieces_of
from serial_communication.tools.wire.recording import Read, Recording
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
