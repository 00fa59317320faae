"""The text of an announcement: any bytes are read, row by row, and nothing is raised."""
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('yaml')
from serial_communication.framing.announcement import (read_announcement,  # noqa: E402
                                                       write_announcement)

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
    (b'a: !!int ""', ''), (b'a: 2001-99-99', 'month'), (b'a: ' + b'[' * 1500 + b']' * 1500, ''),
    (b'a: {frame_id: "\\0"}', 'control'), (b'a: {reply: {layout: "<h\\v"}}', 'control'),
    (b'a: {fields: [x, "\\ud800"]}', 'control'), (b'force: {type: 33}', 'a second row force')])
def test_a_line_that_is_no_row_is_left_out_with_one_line(line, why):
    found = read_announcement(ROW + line + b'\nlevel: {type: 5}\n')
    problem, = found.problems
    assert problem.startswith('line 2 of the announcement is left out: ') and why in problem
    assert '\n' not in problem and len(problem) < 300
    assert found.rows == {'force': FORCE, 'level': {'type': 5}}


# What an AVR announces without PROGMEM: instructions instead of the text.
PROGRAM = bytes.fromhex('0c945c000c946e000c946e00 0a 0c946e00cfef 0a d8e0debfcdbf11e0a0e0b1e0')


@pytest.mark.parametrize('text', [PROGRAM, b'\xff' * 40, bytes(40), b'\7\n\n\7' + PROGRAM * 20])
def test_a_text_that_is_none_is_reported_as_a_forgotten_progmem(text):
    found = read_announcement(text)
    problem, = found.problems
    assert problem.startswith('the announcement is no text: b')
    assert problem.endswith(': PROGMEM missing in the sketch?')
    assert (found.rows, found.firmware) == ({}, '') and len(problem) < 200


def test_one_damaged_line_is_no_forgotten_progmem():
    assert 'PROGMEM' not in str(read_announcement(ROW + PROGRAM).problems)
    assert 'PROGMEM' not in str(read_announcement('Größe\t\r\n'.encode()).problems)


def test_there_are_at_most_16_rows():
    found = read_announcement(b''.join(b'r%d: {}\n' % number for number in range(400)))
    assert list(found.rows) == [f'r{number}' for number in range(16)]
    assert found.problems == ['there may be 16 rows in an announcement: line 17 and all after it '
                              'are left out']
    assert len(read_announcement(b'x\n' * 1024).problems) == 17


def test_nested_references_take_no_memory():
    tracemalloc.start()
    try:
        read_announcement(b'a: {a: &a [1,1,1,1,1,1,1,1,1,1], ' + b''.join(
            b'%c: &%c [%s], ' % (c, c, b','.join([b'*%c' % (c - 1)] * 10))
            for c in range(ord('b'), ord('z'))) + b'}\n')
        _now, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 10 ** 6


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
