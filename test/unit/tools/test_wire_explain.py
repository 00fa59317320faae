"""wire explain: the values of every vector, and damaged bytes."""
import re
import struct
import subprocess
import sys

import pytest

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.simulation.announcing import chunks_of
from serial_communication.tools.wire import explain
from serial_communication.tools.wire.explain import NotHex
from waiting import PATIENCE
from wire_lines import LINKS, ROOT, damaged_stream, settings, vectors

PROGRAM = [sys.executable, ROOT + '/scripts/wire', 'explain']
TO_ARDUINO = (4, 5, 6, 11, 12)      # message types that only a computer sends


def run(*arguments, given=''):
    return subprocess.run(PROGRAM + list(arguments), input=given, timeout=PATIENCE, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def only(link, data, **options):
    """Explain bytes that have exactly one frame."""
    found = explain.explain(data, settings(link)._replace(**options))
    assert len(found) == 1, found
    return found[0]


def value_of(each, name):
    """The value of the only part with that name."""
    found = [part.value for part in each.parts if part.name == name]
    assert len(found) == 1, (name, each.parts)
    return found[0]


def hexed(text):
    return bytes.fromhex(text)


# -- the vectors ----------------------------------------------------------------------------------

BUS = vectors('robot_ctrl_bus')
MCU = vectors('mcu')['frames']
ARDUINO = vectors('arduino')['packets']


@pytest.mark.parametrize('case', BUS['requests'], ids=lambda case: case['frame'])
def test_a_bus_request_is_explained_by_its_values(case):
    each = only('bus', hexed(case['frame']))
    assert each.sent and not each.trouble
    assert (value_of(each, 'CMD1'), value_of(each, 'CMD2')) == (case['cmd1'], case['cmd2'])
    assert b''.join(part.data for part in each.parts[4:-1]) == hexed(case['data'])


@pytest.mark.parametrize('case', BUS['replies'], ids=lambda case: case['frame'])
def test_a_bus_reply_is_explained_by_its_values(case):
    asked = re.search(r'smoke (\d+), (\S+) C, (\S+) %', case['name'])
    request = bus.encode_request(bus.ENVIRONMENT_REQUEST if asked else bus.SYNC_REQUEST)
    *_, each = explain.explain(request + hexed(case['frame']), settings('bus'))
    assert not each.sent and not each.trouble
    assert value_of(each, 'CMD1') == case['cmd1']
    assert b''.join(part.data for part in each.parts[3:-1]) == hexed(case['data'])
    if 'error' in case:
        assert value_of(each, 'error code') == case['error']
    if asked:
        assert [value_of(each, name) for name in ('smoke', 'temperature', 'humidity')] == [
            pytest.approx(float(number)) for number in asked.groups()]


@pytest.mark.parametrize('case', MCU, ids=lambda case: case['frame'])
def test_an_mcu_frame_is_explained_by_its_values(case):
    each = only('mcu', hexed(case['frame']))
    assert not each.sent and not each.trouble
    assert (value_of(each, 'TYPE'), value_of(each, 'SEQ')) == (case['type'], case['seq'])
    names = {'vl53_1': 'range_1', 'vl53_2': 'range_2'}
    wanted = dict(case['value'])
    wanted.update((f'adc{index}', value) for index, value in enumerate(wanted.pop('adc', ())))
    for name, value in wanted.items():
        assert value_of(each, names.get(name, name)) == pytest.approx(value), name


@pytest.mark.parametrize('case', ARDUINO, ids=lambda case: case['wire'])
def test_an_arduino_packet_is_explained_by_its_values(case):
    each = only('arduino', hexed(case['wire']))
    assert each.sent == (case['type'] in TO_ARDUINO)
    assert value_of(each, 'type') == case['type']
    decoded = b''.join(part.data for part in each.parts
                       if part.name not in ('COBS code', 'end'))
    assert decoded == bytes((case['type'],)) + hexed(case['payload'])
    if case['type'] == 9:
        raw = [part.raw for part in each.parts if part.name not in ('COBS code', 'type', 'end')]
        assert raw == list(struct.unpack('>11h', hexed(case['payload'])))
    elif 'value' in case:
        name = 'text' if isinstance(case['value'], str) else 'value'
        assert value_of(each, name) == (case['value'] if name == 'text'
                                        else pytest.approx(case['value']))


# -- damage ---------------------------------------------------------------------------------------

SOURCES = {'bus': [case['frame'] for key in ('requests', 'replies') for case in BUS[key]],
           'mcu': [case['frame'] for case in MCU], 'arduino': [case['wire'] for case in ARDUINO]}


def is_complete(data, found, link):
    """Whether every byte is in a frame or noise, in order. Invalid frames may share their bytes."""
    nothing = b'\0' if link == 'arduino' else b''
    at = first = 0
    for each in found:
        raw = each.frame.raw
        start = at if data.startswith(raw, at) else data.find(raw, first)
        assert start >= 0, raw
        assert not data[at:start].strip(nothing), data[at:start]
        assert b''.join(raw[part.start:part.end] for part in each.parts) == raw
        at = max(at, start + len(raw))
        first = start + 1 if each.frame.cause else at
    return not data[at:].strip(nothing)


@pytest.mark.parametrize('link', LINKS)
def test_a_damaged_stream_is_explained_with_all_its_bytes(link):
    """For the parts of any bytes as one frame, see test_wire_fields."""
    for seed in range(20):
        data = damaged_stream(link, seed, 40)
        found = explain.explain(data, settings(link))
        assert is_complete(data, found, link)
        invalid = [each for each in found if each.frame.cause]
        assert invalid and all(each.trouble for each in invalid)
        for each in found:
            assert '\n' not in each.trouble


@pytest.mark.parametrize('link', LINKS)
def test_an_incomplete_frame_is_explained_as_far_as_it_goes(link):
    for text in SOURCES[link]:
        data = hexed(text)
        for size in range(1, min(len(data), 40)):
            assert is_complete(data[:size], explain.explain(data[:size], settings(link)), link)
    each = only('mcu', hexed('020c109c2f003a'))
    assert each.trouble == 'incomplete'
    assert [(part.name, part.data, part.error) for part in each.parts[4:6]] == [
        ('range_1', b'\x2f\0', ''), ('range_2', b'\x3a', 'missing, 1 byte')]


def test_a_wrong_checksum_is_shown_with_the_right_one():
    done = run('mcu', '020c109c2f003a0000000dfff3009903')
    assert done.returncode == 1
    assert re.search(r'99 +CRC +153 +should be 0x98', done.stdout)


def test_a_packet_inside_an_invalid_one_is_not_shown_as_valid():
    """Noise before a packet makes it invalid, though the same packet follows."""
    ticks = '03 08 02 00 '
    for before in '05 ' + ticks, '01 ' * 300 + ticks:
        found = explain.explain(hexed(before + ticks), settings('arduino'), False)
        assert [each.frame.raw for each in found if not each.trouble] == [hexed(ticks)]
        assert b''.join(each.frame.raw for each in found)[-4:] == hexed(ticks)


def test_a_reply_is_explained_by_the_request_before_it():
    found = explain.explain(hexed('a5025522d0 a506025e01030acc1229'), settings('bus'))
    assert [(each.sent, each.trouble) for each in found] == [(True, ''), (False, '')]
    assert value_of(found[1], 'smoke') == 350
    found = explain.explain(hexed('a50255200064b6 a506025e01030acc1229'), settings('bus'))
    assert [part.name for part in found[1].parts][3:-1] == ['DATE']


FORCE = (b'force: {type: 32, ros_type: any/Type, layout: "<h", fields: [data], scale: 0.01}\n'
         b'wrong: {typ: 5}\n')
PUMP = b'pump: {cmd2: 0x30, srv_type: any/Type, request: {layout: "<B", fields: [data]}}\n'


def test_announced_messages_are_known_in_all_of_the_bytes():
    message = arduino.encode_raw(32, (1234).to_bytes(2, 'little'))
    chunks = b''.join(map(arduino.encode, chunks_of(FORCE, 20)))
    found = explain.explain(message + chunks, settings('arduino'))
    assert value_of(found[0], 'data') == 12.34 and not found[0].trouble
    assert explain.explain(message + chunks[:-1], settings('arduino'))[0].trouble


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


def test_the_status_says_whether_all_is_valid_and_usable():
    assert run('bus', 'a5', '00', '02', 'a7').returncode == 0
    assert run('bus', given='a50002a7\n').returncode == 0
    assert run('bus', '-', given='a50002a7\n').returncode == 0
    assert run('bus', 'a50002a6').returncode == 1
    for arguments in (['bus', 'hello'], ['bus', ''], ['ferry', 'a5'], []):
        done = run(*arguments)
        assert done.returncode == 2 and 'Traceback' not in done.stderr
    assert len(run('bus', 'hello').stderr.splitlines()) == 1
