"""Chunks of announcements, their assembly, and their text, for which any bytes are read."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from links import ArduinoLink
from serial_communication.boards.arduino.wire import encode_raw
from serial_communication.framing.announcement import (LONGEST, Assembly, Chunk, crc_of,
                                                       read_announcement)
from serial_communication.simulation.announcing import chunks_of, write_announcement
from serial_communication.transport.port import Port

TEXT = (b'firmware: nano_car 1.1.0\n'
        b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data]}\n')
OTHER = TEXT.replace(b'32', b'33', 1)


def taken(assembly, chunks):
    """The texts that these chunks complete."""
    return [text for text in map(assembly.add, chunks) if text is not None]


def test_a_chunk_has_an_index_a_count_the_crc_in_little_endian_and_text():
    first, second = chunks_of(b'123456789', 5)     # the check value of CRC-16/CCITT-FALSE
    assert first.pack() == b'\x00\x02\xb1\x29' + b'12345'
    assert second.pack() == b'\x01\x02\xb1\x29' + b'6789'
    assert Chunk.unpack(second.pack()) == second and Chunk.TYPE == 255
    assert str(first) == "announcement index=0 count=2 crc=10673 text=b'12345'"


texts, sizes, few = st.binary(max_size=300), st.integers(2, 249), st.integers(0, 3)
byte = st.one_of(few, st.integers(0, 255))
any_chunk = st.builds(Chunk, byte, byte, st.one_of(few, st.integers(0, 0xFFFF)),
                      st.binary(max_size=251))


@given(data=st.data(), first=texts, second=texts, size=sizes)
def test_chunks_that_are_lost_repeated_and_of_two_texts_give_each_text_and_no_other(
        data, first, second, size):
    old, new = chunks_of(first, size), chunks_of(second, size)
    found = taken(Assembly(), data.draw(st.lists(st.sampled_from(old + new),
                                                 max_size=3 * len(old + new)))
                  + data.draw(st.permutations(new)))
    assert found[-1] == second and set(found) <= {first, second}
    assert all(one != other for one, other in zip(found, found[1:]))


@given(damaged=st.lists(any_chunk, max_size=60), text=texts, size=sizes)
def test_after_any_chunks_two_valid_rounds_give_the_text(damaged, text, size):
    chunks, assembly, crcs = chunks_of(text, size), Assembly(), set()
    for chunk in damaged + [chunks[0]._replace(text=b'x')] + chunks * 2:
        crcs.add(chunk.crc)
        found = assembly.add(chunk)
        assert found is None or crc_of(found) in crcs
    # Not `text` if another one of the same CRC was completed before: they are the same to it.
    assert crc_of(assembly.text) == crc_of(text)


def test_the_same_text_again_is_not_returned():
    assembly = Assembly()
    assert taken(assembly, chunks_of(TEXT, 20) * 3) == [TEXT]
    assembly.reset()
    assert taken(assembly, chunks_of(TEXT, 20)) == []
    assert taken(assembly, chunks_of(TEXT, 33)) == []


def test_a_chunk_of_the_known_text_confirms_it_after_the_port_was_opened():
    assembly = Assembly()
    taken(assembly, chunks_of(TEXT, 20))
    assert assembly.confirmed
    assembly.reset()
    assert not assembly.confirmed
    assembly.add(chunks_of(OTHER, 20)[0])
    assert not assembly.confirmed
    assembly.add(chunks_of(TEXT, 20)[2])
    assert assembly.confirmed


@pytest.mark.parametrize('received, end', [(0, 5.0), (1, 20.0), (9, 5.0)])
def test_an_unknown_type_is_an_error_once_the_board_cannot_announce_it_any_more(received, end):
    link = ArduinoLink(Port('/dev/none'))
    board = link.session.announcement
    board.on_text = lambda text: board.use(text, '', [])
    for chunk in chunks_of(TEXT, 20)[:received]:
        board.add(chunk)
    for time, count in (0.0, 0), (end - 0.1, 0), (end, 1):
        link.receiver.take(encode_raw(40, b''), None, time)
        assert link.session.errors['unknown type'] == count


def test_a_text_that_is_too_long_has_no_rows():
    row = b'a: {type: 32}\n'
    for text, rows in (row.ljust(LONGEST), {'a': {'type': 32}}), (row.ljust(LONGEST + 1), {}):
        assert taken(Assembly(), chunks_of(text, 251)) == [text]
        assert read_announcement(text).rows == rows
    assert 'over 2048 bytes' in read_announcement(text).problems[0]


# -- the text -------------------------------------------------------------------------------------

ROW = b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data], scale: 0.01}\n'
FORCE = {'type': 32, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data'],
         'scale': 0.01}


@pytest.mark.parametrize('text, firmware, rows', [
    (b'', '', {}), (ROW, '', {'force': FORCE}),
    (b'firmware: nano_car 1.1.0\n' + ROW, 'nano_car 1.1.0', {'force': FORCE}),
    (b'firmware: nano_car 1.1.0\r\n\r\n' + ROW.strip(), 'nano_car 1.1.0', {'force': FORCE}),
    ('firmware: ärger \x07 1\n'.encode(), 'ärger \N{REPLACEMENT CHARACTER} 1', {}),
    (b'firmware: {type: 3}\n', '', {'firmware': {'type': 3}}),
    (b'# nothing\n', '', {})])
def test_a_text_is_read(text, firmware, rows):
    found = read_announcement(text)
    assert (found.firmware, found.rows) == (firmware, rows)
    assert bool(found.problems) == (text == b'# nothing\n')


@pytest.mark.parametrize('line, why', [
    (b'a: {type: 5', 'expected'), (b'a: &x {b: *x}', 'reference'),
    (b'a: {b: &x [1], c: *x}', 'reference'), (b'\xff: {}', "can't decode"), (b'5', 'not one row'),
    (b'a', 'not one row'), (b'{a: {}, b: {}}', 'not one row'), (b'[]: {}', 'unhashable'),
    (b'yes: {}', 'no text'), (b'a: !!python/object:os.system x', 'constructor'),
    (b'a: !!int ""', ''), (b'a: 2001-99-99', 'month'), (b'a: ' + b'[' * 900 + b']' * 900, ''),
    (b'force: {type: 33}', 'a second row force')])
def test_a_line_that_is_no_row_is_left_out_with_one_line(line, why):
    found = read_announcement(ROW + line + b'\nlevel: {type: 5}\n')
    problem, = found.problems
    assert problem.startswith('line 2 of the announcement is left out: ') and why in problem
    assert '\n' not in problem and len(problem) < 300
    assert found.rows == {'force': FORCE, 'level': {'type': 5}}


def test_there_are_at_most_16_rows():
    found = read_announcement(b''.join(b'r%d: {}\n' % number for number in range(100)))
    assert list(found.rows) == [f'r{number}' for number in range(16)]
    assert found.problems == ['there may be 16 rows in an announcement: line 17 and all after it '
                              'are left out']
    assert len(read_announcement(b'x\n' * 1024).problems) == 17


@given(st.one_of(st.binary(max_size=300), st.text(max_size=300).map(
    lambda text: text.encode('utf-8', 'replace')), st.lists(st.sampled_from(
        [b'a', b': ', b'{', b'}', b'[', b']', b'&a ', b'*a', b'!!int ', b'"', b"'", b'\n', b'? ',
         b'- ', b'<<: ', b'firmware: ', b'1', b'\xff', b'|', b'>', b'%', b'---', b'#', b','])
        ).map(b''.join)))
def test_any_bytes_raise_nothing(text):
    found = read_announcement(text)
    assert len(found.rows) + len(found.problems) <= 17
    assert all('\n' not in problem for problem in found.problems)


SCALARS = st.one_of(st.integers(-10 ** 6, 10 ** 6), st.floats(allow_nan=False), st.booleans(),
                    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20))


@given(st.dictionaries(st.sampled_from(('force', 'yes', 'null', 'on', 'x1')), st.dictionaries(
    st.sampled_from(('type', 'layout', 'fields', 'scale', 'frame_id')),
    st.one_of(SCALARS, st.lists(SCALARS, max_size=3)), max_size=4), max_size=4))
def test_rows_are_announced_and_read_unchanged(rows):
    found = read_announcement(write_announcement(rows, 'nano_car 1.1.0'))
    assert found == ('nano_car 1.1.0', rows, [])
