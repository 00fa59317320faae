"""The library's links on the PC, against the protocols in by_definition.py; see pc_board.cpp."""
import glob
import os
import random
import struct
import subprocess
from collections import defaultdict

import pytest
from by_definition import (ADC, ANNOUNCEMENT, ECHO, FUNCTION, SETTING, SYNC, arduino_at,
                           arduino_packet, decode, mcu_at, mcu_frame, reply_at, request_at)
from decoding import hexed, vectors

import compilers
from board_rows import car_settings
from packets import MALFORMED, OK, STOP, UNSUPPORTED, function, request, steering
from serial_communication.framing.announcement import Assembly, Chunk, read_announcement

INVALID = b'\xff'


@pytest.fixture(scope='module')
def board(tmp_path_factory):
    """A function: the lines that pc_board prints, of a script of words; bytes are HEX in it."""
    path = compilers.program(tmp_path_factory.mktemp('pc') / 'board',
                             os.path.join(compilers.HERE, 'pc_board.cpp'))

    def run(arguments, *script):
        words = [word.hex() if isinstance(word, bytes) else word for word in script]
        done = subprocess.run([path, *arguments.split()], input=' '.join(words),
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                              universal_newlines=True, check=False)
        assert done.returncode == 0, done.stdout
        return done.stdout.splitlines()
    return run


def calls(lines):
    """The functions that were called, with their data."""
    return [line.split(' ', 1)[1].strip() for line in lines if ' sent ' not in line]


def sent(lines):
    """What was sent in each ms."""
    found = defaultdict(bytes)
    for line in lines:
        if ' sent ' in line:
            found[int(line.split()[0])] += hexed(line.split()[-1])
    return found


def frames(lines, frame_at):
    """The (ms, frame) of all that was sent."""
    return [(ms, frame) for ms, data in sent(lines).items() for frame in decode(data, frame_at)[0]]


# Packets and frames from a board


def test_packets_of_any_content_are_sent(board):
    chance = random.Random(1)
    packets = [hexed(pair['decoded']) for pair in vectors('cobs')['pairs']]
    packets += [bytes(chance.choice([0, chance.randrange(256)])
                      for _ in range(chance.randrange(1, 63))) for _ in range(300)]
    packets = [packet for packet in packets if 0 < len(packet) < 63]
    lines = board('packets', *(word for packet in packets
                               for word in (arduino_packet(52, packet), '+10')))
    assert list(sent(lines).values()) == [arduino_packet(packet[0], packet[1:])
                                          for packet in packets]


def test_frames_are_sent(board):
    found = decode(b''.join(sent(board('frames busy', '+15000')).values()), mcu_at)[0]
    assert [frame.content for frame in found] == [
        (ADC, number % 256, struct.pack('<6H', 1, 2, 300, 4, 5, 1023)) for number in range(300)]


# Packets to a board


def damaged(chance, data):
    """Bytes that a line has cut, flipped, or doubled."""
    at, how = chance.randrange(len(data)), chance.randrange(4)
    if how == 0:
        return data[:at]
    if how == 1:
        return data[:at] + bytes((data[at] ^ 1 << chance.randrange(8),)) + data[at + 1:]
    return data * how


def some_bytes(chance, size):
    return bytes(chance.choice([0xA5, 0x5A, 0, 1, chance.randrange(256)]) for _ in range(size))


def test_packets_among_damage_call_their_functions(board):
    chance = random.Random(2)
    stream = b''
    for _ in range(3000):
        wire = arduino_packet(chance.choice([5, 11, 12, 13, 48, 50, 253, 255]),
                              some_bytes(chance, chance.choice([0, 1, 2, 2, 3, 30, 62, 63, 80])))
        stream += damaged(chance, wire) if chance.random() < 0.3 else wire
    sizes = {5: [2], 12: [0], 48: [2], 50: range(64)}
    expected = [f'{frame.type} {frame.data.hex()}'.strip()
                for frame in decode(stream, arduino_at)[0]
                if len(frame.data) in sizes.get(frame.type, [])]
    words = []
    while stream:
        size = chance.randrange(1, 60)      # a call takes 64 bytes
        words += [stream[:size], '+1']
        stream = stream[size:]
    assert len(expected) > 500 and calls(board('packets', *words)) == expected


@pytest.mark.parametrize('pause, executed', [(49, ['5 dc05']), (60, [])])
def test_a_packet_whose_end_does_not_come_is_given_up(board, pause, executed):
    """50 ms after its last byte; and it takes no whole one with it."""
    wire = steering(1500)
    assert calls(board('packets', wire[:2], f'+{pause}', wire[2:], '+1', steering(7), '+1')) == [
        *executed, '5 0700']


def test_update_takes_at_most_64_bytes_a_call(board):
    """So that loop() goes on, and the watchdog is served, whatever the line brings."""
    lines = board('packets', arduino_packet(12) * 100, '+5')
    assert [int(line.split()[0]) for line in lines] == sorted(
        (3 * index + 2) // 64 for index in range(100))
    assert {len(data) for data in sent(board('bus', request(SYNC) * 100, '+13')).values()} == {
        8 * 4, 4 * 4}


# Requests to a board


ANY, MOVE = 51, 49      # functions of pc_board.cpp


def reply_to(frame):
    """What it answers while nothing moves."""
    if frame.type == FUNCTION:
        return OK if frame.number == ANY else UNSUPPORTED if frame.number != STOP else \
            MALFORMED if frame.data else OK
    return {SYNC: b'\0', ECHO: b'\1' + frame.data}.get(frame.type, UNSUPPORTED)


def replies(lines):
    return [bytes((frame.type,)) + frame.data
            for frame in decode(b''.join(sent(lines).values()), reply_at)[0]]


def test_requests_among_damage_are_answered_and_executed_once(board):
    """For a burst with damage, INVALID is said at most once."""
    chance = random.Random(4)
    words, valid, bursts = [request(SYNC), '+60'], [], 0
    while bursts < 1000:
        burst = b''
        for _ in range(chance.randrange(1, 4)):
            frame = request(chance.choice([0, 1, 0x55, 0x55, 9]), chance.choice([50, ANY, STOP]),
                            some_bytes(chance, chance.choice([0, 1, 2, 2, 7, 60, 255, 299])))
            burst += chance.choice([frame, frame, damaged(chance, frame), some_bytes(chance, 8),
                                    hexed('a5025522d0')])
        if burst and bytes((FUNCTION, MOVE)) not in burst:
            bursts += 1
            cut = chance.randrange(len(burst))
            words += [burst[:cut], '+10', burst[cut:], '+70']
            valid += decode(burst, request_at, at_end=True)[0]
    lines = board('bus', *words)
    found = replies(lines)
    assert [reply for reply in found if reply[:1] != INVALID] == [b'\0', *map(reply_to, valid)]
    assert 0 < len(found) - 1 - len(valid) < bursts
    assert calls(lines) == [f'{ANY} {frame.data.hex()}'.strip() for frame in valid
                            if (frame.type, frame.number) == (FUNCTION, ANY)]


@pytest.mark.parametrize('words, said', [
    ((request(ECHO, 0, b'x'),), [INVALID + b'\x10']),
    ((request(SYNC), request(ECHO, 0, b'x')[:-1] + b'\0'), [b'\0', INVALID + b'\x40']),
    ((request(SYNC), b'\x5a\x2d\x01\1\0'), [b'\0', INVALID + b'\x20']),
    ((request(SYNC), request(ECHO, 0, b'x')[:-1] + b'\0' + request(ECHO)), [b'\0', b'\1']),
    ((request(SYNC), b'\xa5\x10'), [b'\0']),
    # In two pieces of 64 bytes: no silence is between them.
    ((request(SYNC), 60 * b'\7', request(SYNC)[:-1] + b'\6', request(SYNC)), [b'\0', b'\0']),
    ((request(SYNC), function(0xFF, 200)), [b'\0', UNSUPPORTED]),
])
def test_what_is_said_of_damage(board, words, said):
    assert replies(board('bus', *words, '+80')) == said


@pytest.mark.parametrize('moving', [False, True])
def test_a_stop_behind_a_false_start_is_found_in_time(board, moving):
    """A damaged length cannot hold it back, whatever comes meanwhile."""
    for count in range(12):
        slow = ['+10', b'\0']
        lines = board('bus', request(SYNC), *[function(MOVE)] * moving, b'\x5a\x2c\1',
                      *slow * count, function(STOP)[:2], '+20', function(STOP)[2:], *slow * 9)
        assert replies(lines) == [b'\0', *[OK] * (1 + moving)], count
        assert calls(lines) == [str(MOVE), 'stop'] * moving


# Settings and announcements

NUMBERS = [1, 2, 3, 4, 5, 200]      # those of pc_board.cpp
FLOAT = struct.Struct('<Bf').pack


@pytest.mark.parametrize('asked, used', [
    (FLOAT(1, 2.5), FLOAT(1, 2.5)), (FLOAT(1, 11), FLOAT(1, 10)),
    (FLOAT(1, float('-inf')), FLOAT(1, 0)),
    (FLOAT(1, float('nan')), FLOAT(1, 0.5)), (b'\1\1', FLOAT(1, 0.5)), (b'\1', FLOAT(1, 0.5)),
    (b'\2\x60\xea', b'\2\x60\xea'), (b'\2\xff\xff', b'\2\x60\xea'), (b'\2\0\0', b'\2\5\0'),
    (b'\3\0', b'\3\0'), (b'\3\2', b'\3\1'), (b'\4\x80', b'\4\x9c'), (b'\4\x7f', b'\4\x64'),
    (b'\5\1\0\0\1', b'\5\1\0\0\1'), (b'\5\2\0\0\1', b'\5\1\0\0\1'),
    (b'\5\0\0\0\x80', b'\5\1\0\0\x80'),
    (b'\xc8\xff\xff\xff\xff', b'\xc8\xff\xff\xff\xff'), (b'\xc8\0\0\0\0', b'\xc8\7\0\0\0'),
    (b'\x09\1', None), (b'', None), (b'\1xxxxx', None)])
def test_a_setting_is_bounded_and_answered_with_what_is_in_use(board, asked, used):
    for kind, wire, frame_at in (('packets', arduino_packet(SETTING, asked), arduino_at),
                                 ('frames', mcu_frame(SETTING, 0, asked), mcu_at)):
        lines = board(kind + ' settings', '+100', wire, '+100')
        answers = [frame.data for ms, frame in frames(lines, frame_at)
                   if ms >= 100 and frame.type == SETTING]
        assert answers == [used] * (used is not None)
        initial = [frame.data for ms, frame in frames(lines, frame_at) if ms < 100]
        assert [data[0] for data in initial] == NUMBERS
        has_changed = used is not None and used not in initial
        assert calls(lines) == ['changed %d' % each for each in asked[:1] * has_changed]


def test_settings_among_damage_reach_a_sensor_board(board):
    chance, words, wanted = random.Random(5), [], []
    for number in range(2000):
        wire = mcu_frame(SETTING, number % 256, FLOAT(1, number % 1000 / 100))
        noise = bytes(chance.choice(b'\2\7\xfd\3') for _ in range(chance.randrange(4)))
        words += [wire[:chance.randrange(11)] + noise + wire, '+5']
        wanted.append(FLOAT(1, number % 1000 / 100))
    found = [frame.data for _, frame in frames(board('frames settings', '+10', *words), mcu_at)]
    assert [data for data in found if data[0] == 1][1:len(wanted) + 1] == wanted


def chunks(lines, frame_at):
    return [(ms, Chunk.unpack(frame.data)) for ms, frame in frames(lines, frame_at)
            if frame.type == ANNOUNCEMENT]


@pytest.mark.parametrize('kind, frame_at, period', [
    ('packets', arduino_at, 10), ('frames', mcu_at, 50)])
def test_chunks_are_sent_ten_times_a_second_until_all_have_gone_twice(
        board, kind, frame_at, period):
    """And then once a second; with each, a setting is reported."""
    beat = arduino_packet(11) if kind == 'packets' else b'\0'
    lines = board(kind + ' rows settings busy', '+12000', *[beat, '+10'] * 300)
    found = chunks(lines, frame_at)
    count = found[0][1].count
    often = max(30, 2 * count)
    gaps = [(ms, ms - last) for (last, _), (ms, _) in zip(found, found[1:])]
    assert all(100 <= gap <= 100 + period for _, gap in gaps[:often - 1])
    assert all(1000 <= gap <= 1000 + period for ms, gap in gaps[often:] if ms < 12000)
    again = [gap for ms, gap in gaps if ms > 12000]     # heartbeats come
    assert len(again) >= 29 if kind == 'packets' else len(again) == 3
    assembly = Assembly()
    text, = {text for text in (assembly.add(chunk) for _, chunk in found) if text}
    announced = read_announcement(text)
    assert announced.firmware == 'test 1.0' and announced.problems == []
    read = {row.name: (row.number, row.code, row.minimum, row.maximum, row.unit, row.description)
            for row in car_settings(announced.rows)}
    assert read == {
        'gain': (1, 'f', 0, 10, '1/s', 'a gain'), 'period': (2, 'H', 5, 60000, 'ms', 'a period'),
        'inverted': (3, '?', 0, 1, '', 'whether it turns the other way'),
        'trim': (4, 'b', -100, 100, '', ''), 'mask': (200, 'I', 7, 2 ** 32 - 1, '', ''),
        'position': (5, 'i', 1 - 2 ** 31, 16777217, '', '')}
    reports = [frame.data[0] for _, frame in frames(lines, frame_at) if frame.type == SETTING]
    turns = reports[len(NUMBERS):]
    assert turns == [NUMBERS[index % 6] for index in range(len(turns))] and len(turns) > 20


@pytest.mark.parametrize('kind', ['packets', 'frames'])
def test_no_packet_of_the_sketch_waits_for_a_chunk(board, kind):
    lines = board(kind + ' rows busy', '+5000')
    assert len(lines) > 100 and not any('waits' in line for line in lines)


@pytest.mark.parametrize('kind', ['packets', 'frames'])
def test_a_sketch_that_announces_nothing_sends_nothing(board, kind):
    assert board(kind, arduino_packet(11), '+5000') == []


@pytest.mark.parametrize('compiler', [
    compilers.ON_THE_PC + ['-fsigned-char'], compilers.ON_THE_PC + ['-funsigned-char'],
    compilers.on_the_avr(), compilers.ON_THE_ESP], ids=['PC', 'PC, unsigned char', 'AVR', 'ESP'])
def test_headers(compiler, tmp_path):
    """All at once, in either order, so that none leans on another."""
    headers = sorted(os.path.basename(path) for path in glob.glob(compilers.HEADERS + '/*.h')
                     if compiler[0] == 'avr-g++' or not os.path.basename(path).startswith('avr_'))
    for order in headers, headers[::-1]:
        (tmp_path / 'headers.cpp').write_text(''.join(map('#include <{}>\n'.format, order)))
        compilers.check(compiler, tmp_path / 'headers.cpp')
