"""Chunks of announcements and their assembly."""
import struct

import pytest

from serial_communication.framing.announcement import (LONGEST, Assembly, Chunk, chunks_of, crc_of)

TEXT = (b'firmware: nano_car 1.1.0\n'
        b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data]}\n')
OTHER = TEXT.replace(b'32', b'33', 1)


def taken(assembly, chunks):
    """The texts that these chunks complete."""
    return [text for text in map(assembly.take, chunks) if text is not None]


def test_the_crc_is_ccitt_false():
    assert crc_of(b'123456789') == 0x29B1      # the check value of its definition
    assert crc_of(b'') == 0xFFFF


def test_a_chunk_has_an_index_a_count_the_crc_in_little_endian_and_text():
    first, second = chunks_of(b'123456789', 5)
    assert first.pack() == b'\x00\x02\xb1\x29' + b'12345'
    assert second.pack() == b'\x01\x02\xb1\x29' + b'6789'
    assert Chunk.unpack(second.pack()) == second and Chunk.TYPE == 255
    assert str(first) == 'announcement 1/2 (CRC 29b1): 12345'


def test_a_chunk_without_a_whole_header_has_the_wrong_length():
    for size in range(4):
        with pytest.raises(struct.error):
            Chunk.unpack(bytes(size))


@pytest.mark.parametrize('index, count', [(0, 0), (1, 1), (255, 255)])
def test_an_index_beyond_the_count_is_implausible(index, count):
    chunk = Chunk(index, count, crc_of(b''), b'')
    assert chunk.implausible() and chunk.parts(chunk.pack())[0].error == chunk.implausible()
    assert Assembly().take(chunk) is None


def test_a_character_cut_by_a_chunk_is_shown_and_kept():
    first, second = chunks_of('°'.encode(), 1)
    assert str(first).endswith('\N{REPLACEMENT CHARACTER}')
    assert taken(Assembly(), [first, second]) == ['°'.encode()]


@pytest.mark.parametrize('size', [1, 7, 50, 251, 4096])
def test_a_text_is_assembled_from_chunks_of_any_size_and_order(size):
    chunks = chunks_of(TEXT[:200], size)
    assert taken(Assembly(), chunks) == [TEXT[:200]]
    assert taken(Assembly(), chunks[::-1]) == [TEXT[:200]]
    assert taken(Assembly(), [each for each in chunks for _ in range(3)]) == [TEXT[:200]]


def test_an_empty_text_is_one_chunk():
    assert taken(Assembly(), chunks_of(b'', 10)) == [b'']


def test_the_same_text_again_is_not_returned():
    assembly = Assembly()
    assert taken(assembly, chunks_of(TEXT, 20) * 3) == [TEXT]
    assembly.reset()
    assert taken(assembly, chunks_of(TEXT, 20)) == []
    assert taken(assembly, chunks_of(TEXT, 33)) == []


def test_a_text_that_changes_is_returned_and_never_mixed():
    assembly = Assembly()
    assert len(OTHER) == len(TEXT)
    assert taken(assembly, chunks_of(TEXT, 20)[:3] + chunks_of(OTHER, 20)) == [OTHER]
    assert taken(assembly, chunks_of(TEXT, 20)) == [TEXT]
    assert taken(assembly, chunks_of(OTHER, 20)) == [OTHER]


def test_lost_chunks_come_with_the_next_round():
    chunks = chunks_of(TEXT, 20)
    assembly = Assembly()
    assert taken(assembly, chunks[1::2]) == []
    assert taken(assembly, chunks[::2]) == [TEXT]


@pytest.mark.parametrize('damaged', [
    dict(text=b'firmware: nano_cat 1'), dict(text=b''), dict(crc=1), dict(count=200),
    dict(index=3)])
def test_a_damaged_chunk_is_replaced_by_the_next_valid_one(damaged):
    chunks = chunks_of(TEXT, 20)
    broken = chunks[0]._replace(**damaged)
    assert taken(Assembly(), [broken, *chunks]) == [TEXT]
    assert taken(Assembly(), [chunks[0], broken, *chunks[1:], *chunks]) == [TEXT]


def test_a_damaged_chunk_of_the_known_text_changes_nothing():
    assembly = Assembly()
    chunks = chunks_of(TEXT, 20)
    assert taken(assembly, chunks) == [TEXT]
    assert taken(assembly, [chunks[0]._replace(text=b'x'), *chunks]) == []


def test_a_chunk_of_the_known_text_confirms_it_after_the_port_was_opened():
    assembly = Assembly()
    taken(assembly, chunks_of(TEXT, 20))
    assert assembly.confirmed
    assembly.reset()
    assert not assembly.confirmed
    assembly.take(chunks_of(OTHER, 20)[0])
    assert not assembly.confirmed
    assembly.take(chunks_of(TEXT, 20)[2])
    assert assembly.confirmed


def test_a_text_with_the_same_crc_is_noticed_after_the_port_was_opened():
    target = crc_of(b'a: {}')
    twin = next(text for text in (b'b%d' % number for number in range(10 ** 6))
                if crc_of(text) == target)
    assembly = Assembly()
    assert taken(assembly, chunks_of(b'a: {}', 20)) == [b'a: {}']
    assembly.reset()
    assert taken(assembly, chunks_of(twin, 20)) == [twin]


def test_a_text_that_is_too_long_is_refused_and_the_next_one_is_taken():
    with pytest.raises(ValueError, match='may be at most 2048'):
        chunks_of(bytes(LONGEST + 1), 251)
    with pytest.raises(ValueError, match='may be at most 1275'):
        chunks_of(bytes(2000), 5)
    assembly = Assembly()
    with pytest.raises(ValueError, match='over 2048 bytes'):
        taken(assembly, [Chunk(index, 200, 1, bytes(250)) for index in range(9)])
    longest = b'x' * LONGEST
    assert taken(assembly, chunks_of(longest, 251)) == [longest]


def test_memory_is_bounded_whatever_is_received():
    assembly = Assembly()
    for crc in range(3000):
        for index in range(8):
            assembly.take(Chunk(index, 255, crc, bytes(251)))
    assert len(assembly._begun) <= 4
    assert sum(len(text) for pieces in assembly._begun.values()
               for text in pieces.values()) <= 4 * LONGEST
