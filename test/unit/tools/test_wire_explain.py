"""wire explain: the values of every vector, damaged bytes, and the parts of any bytes."""
import re
import subprocess
import sys

import crane_scale
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lines import ROOT
from waiting import PATIENCE
from wire_lines import FRAMES, LINKS, damaged_stream, settings

from serial_communication.framing.stream import IMPLAUSIBLE
from serial_communication.tools.wire import explain
from serial_communication.tools.wire.explain import NotHex
from serial_communication.tools.wire.fields import Explainer
from serial_communication.tools.wire.lines import Settings

hexed = bytes.fromhex


def run(*arguments, given=''):
    return subprocess.run([sys.executable, ROOT + '/scripts/wire', 'explain', *arguments],
                          input=given, timeout=PATIENCE, text=True, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE)


def only(link, text):
    """Explain bytes that are exactly one frame."""
    each, = explain.explain(hexed(text), settings(link))
    return each


def value_of(each, name):
    """The value of the only part with that name."""
    found = [part.value for part in each.parts if part.name == name]
    assert len(found) == 1, (name, each.parts)
    return found[0]


# -- frames ---------------------------------------------------------------------------------------

def check_whole(data, parts):
    """The parts are in order, without gaps, and cover all bytes."""
    ends = [0, *(part.end for part in parts)]
    assert [part.start for part in parts] == ends[:-1] and ends[-1] == len(data)
    assert all(part.name for part in parts)


@pytest.mark.parametrize('link', LINKS)
def test_every_vector_is_one_frame_with_all_its_bytes(link):
    for frame in FRAMES[link]:
        each = only(link, frame.hex())
        assert each.frame.cause in ('', IMPLAUSIBLE)
        check_whole(frame, each.parts)


@pytest.mark.parametrize('link, text, sent, values', [
    ('bus', 'a50255200064b6', True, {'CMD1': 0x55, 'CMD2': 0x20, 'distance': 100}),
    ('bus', 'a50203028026', False, {'CMD1': 3, 'error code': 0x8002}),
    ('mcu', '020c109c2f003a0000000dfff3009803', False,
     {'TYPE': 16, 'SEQ': 156, 'range_1': 47, 'range_2': 58, 'pitch': -2.43, 'roll': 2.43}),
    ('arduino', '040418fc00', True, {'type': 4, 'value': -1000}),
    ('arduino', '06066c6566740100', True, {'type': 6, 'value': 'left'})])
def test_a_frame_is_explained_by_its_values(link, text, sent, values):
    each = only(link, text)
    assert (each.sent, each.trouble) == (sent, '')
    assert {name: value_of(each, name) for name in values} == values


@pytest.mark.parametrize('link', LINKS)
def test_damaged_frames_are_explained_with_all_their_bytes(link):
    for seed in range(20):
        found = explain.explain(damaged_stream(link, seed, 40), settings(link))
        invalid = [each for each in found if each.frame.cause]
        assert invalid and all(each.trouble and '\n' not in each.trouble for each in invalid)
        for each in found:
            check_whole(each.frame.raw, each.parts)


def test_what_is_missing_or_wrong_is_said():
    each, = explain.explain(hexed('020c109c2f003a'), settings('mcu'))
    assert each.trouble == 'incomplete'
    assert [(part.name, part.data, part.missing) for part in each.parts[4:6]] == [
        ('range_1', b'\x2f\0', 0), ('range_2', b'\x3a', 1)]
    done = run('mcu', '020c109c2f003a0000000dfff3009903')
    assert done.returncode == 1 and re.search(r'99 +CRC +153 +should be 0x98', done.stdout)


def test_a_packet_inside_an_invalid_one_is_not_shown_as_valid():
    """Noise before a packet makes it invalid, though the same packet follows."""
    ticks = '03 08 02 00 '
    for before in '05 ' + ticks, '01 ' * 300 + ticks:
        found = explain.explain(hexed(before + ticks), settings('arduino'), False)
        assert [each.frame.raw for each in found if not each.trouble] == [hexed(ticks)]
        assert found[-1].frame.raw == hexed(ticks)


def test_a_reply_is_explained_by_the_request_before_it():
    found = explain.explain(hexed('a5025522d0 a506025e01030acc1229'), settings('bus'))
    assert [(each.sent, each.trouble) for each in found] == [(True, ''), (False, '')]
    assert value_of(found[1], 'smoke') == 350
    found = explain.explain(hexed('a50255200064b6 a506025e01030acc1229'), settings('bus'))
    assert [part.name for part in found[1].parts][3:-1] == ['DATE']


# -- the parts of any bytes -----------------------------------------------------------------------

def explainer(link, sent=False, **parameters):
    return Explainer(settings(link)._replace(parameters=parameters), sent)


LINES = {'bus': explainer('bus'), 'bus, sent': explainer('bus', True), 'mcu': explainer('mcu'),
         'bus with CMD2': explainer('bus', reply_has_cmd2=True), 'arduino': explainer('arduino'),
         'arduino, sent': explainer('arduino', True),
         'scale': Explainer(Settings(crane_scale.DESCRIPTION, 0), False)}


@pytest.mark.parametrize('line', LINES)
@given(frame=st.binary(max_size=60), start=st.sampled_from((
    b'', b'\xa5', b'\xa5\2\x55\x20', b'\x5a', b'\2\x0c\x10', b'\2\x0e\1', b'\2\2', b'\6\x0a',
    b'\3\x09', b'\5\1\xff', b'\0\0\2\x09', b':0200')))
def test_the_parts_of_any_bytes_are_complete_and_an_incomplete_frame_has_an_error(
        line, frame, start):
    frame = start + frame
    parts = LINES[line].parts(frame)
    check_whole(frame, parts)
    if frame and not any(part.error for part in parts):
        # The damage left a frame, whose message may be refused.
        assert [each.raw for each in LINES[line].decode(frame)] == [frame]


# -- the text of bytes ----------------------------------------------------------------------------

@pytest.mark.parametrize('text', [
    'A5 02 55', 'a50255', '0xA5,0x02,0x55', r'\xa5\x02\x55', '0xA5, 0x2, 0x55', 'a5:02:55',
    'A5\n02\n55\n', '{0xA5, 0x02, 0x55};', r"b'\xa5\x02U'", r'b"\xa5\x02U"', '[165, 2, 85]',
    '[165, 2, 85]\n---', '"a50255"', '0xa50255', '$A5 $02 $55'])
def test_every_form_of_bytes_is_read(text):
    assert explain.parse(text) == b'\xa5\x02\x55'


@pytest.mark.parametrize('text', ['', ' ', 'xy', 'a5 0g', 'a50', '0x', "b'\\xa5", '[165, 256]',
                                  'b"é"', 'A5-02', r'\x'])
def test_text_that_is_not_hex_is_refused(text):
    with pytest.raises(NotHex):
        explain.parse(text)


@pytest.mark.parametrize('arguments, given, status', [
    (['bus', 'a5', '00', '02', 'a7'], '', 0), (['bus'], 'a50002a7\n', 0),
    (['bus', '-'], 'a50002a7\n', 0), (['bus', 'a50002a6'], '', 1), (['bus', 'hello'], '', 2)])
def test_the_status_says_whether_all_is_valid_and_usable(arguments, given, status):
    done = run(*arguments, given=given)
    assert done.returncode == status and len(done.stderr.splitlines()) == (status == 2)
