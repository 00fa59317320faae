"""The protocol headers, compiled for the PC, against the wire's examples and a model in Python."""

import random
import struct
import subprocess

import pytest
from board_ends import request
from by_definition import bus_frame, cobs_encode, xor_of
from decoding import hexed, vectors

VECTORS = {name: vectors(file) for name, file in (
    ('cobs', 'cobs'), ('arduino', 'arduino'), ('bus', 'robot_ctrl_bus'), ('mcu', 'mcu'))}


def plain(text):
    return text.replace(' ', '')


class Driver:
    def __init__(self, program):
        self._process = subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                         universal_newlines=True)

    def __call__(self, line):
        self._process.stdin.write(line + '\n')
        self._process.stdin.flush()
        return self._process.stdout.readline().strip()

    def close(self):
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()


@pytest.fixture
def driver(built):
    driver = Driver(built('protocol_driver'))
    yield driver
    driver.close()


# COBS


@pytest.mark.parametrize(
    'pair', VECTORS['cobs']['pairs'], ids=lambda pair: '%d bytes' % len(hexed(pair['decoded']))
)
def test_cobs_both_ways(driver, pair):
    assert driver('encode ' + plain(pair['decoded'])) == plain(pair['encoded'])
    assert driver('decode ' + plain(pair['encoded'])) == plain(pair['decoded'])


@pytest.mark.parametrize('case', VECTORS['cobs']['rejected'], ids=lambda case: case['name'])
def test_cobs_rejects(driver, case):
    assert driver('decode ' + plain(case['encoded'])) == 'rejected'


def test_cobs_agrees_with_the_model(driver):
    rng = random.Random(1)
    for _ in range(500):
        size = rng.choice([0, 1, 2, 10, 253, 254, 255, 256, 508, 509, 700])
        data = bytes(
            rng.choice([0, 1, rng.randrange(256)]) if rng.random() < 0.1 else rng.randrange(1, 256)
            for _ in range(size))
        encoded = cobs_encode(data)
        assert driver('encode ' + data.hex()) == encoded.hex()
        assert driver('decode ' + encoded.hex()) == data.hex()


# Arduino packets

SENDERS = {4: 'speed %d', 5: 'steering %d', 7: 'angle %d', 8: 'ticks %d', 10: 'voltage %r',
           11: 'heartbeat', 12: 'calibration', 0: 'text 0 %s', 1: 'text 1 %s', 6: 'text 6 %s'}


@pytest.mark.parametrize('packet', VECTORS['arduino']['packets'], ids=lambda packet: packet['wire'])
def test_arduino_packets(driver, packet):
    kind = packet['type']
    assert driver('packet %d %s' % (kind, plain(packet['payload']))) == plain(packet['wire'])
    if kind == 9:
        command = 'imu ' + ' '.join(map(str, struct.unpack('>11h', hexed(packet['payload']))))
    else:
        command = SENDERS[kind] % ((packet['value'],) if 'value' in packet else ())
    assert driver(command) == plain(packet['wire'])
    answer = driver('parse ' + plain(packet['wire']))
    assert answer.startswith('%d:%s' % (kind, plain(packet['payload'])))
    if kind == 4:
        assert '=%d ' % packet['value'] in answer
    if kind == 9:
        assert '=' + plain(packet['payload']) in answer
    if kind == 10:
        assert float(answer.split('=')[1].split()[0]) == pytest.approx(packet['value'], abs=1e-5)
    assert answer.endswith('| cobs=0 long=0 length=0 unknown=0 timeout=0')


def test_every_type_has_its_length(driver):
    lengths = {4: 2, 5: 2, 7: 2, 8: 1, 9: 22, 10: 4, 11: 0, 12: 0}
    for kind in range(13):
        for size in range(0, 40):
            wire = cobs_encode(bytes([kind]) + b'\x01' * size) + b'\x00'
            valid = size <= 31 if kind == 6 else size == lengths.get(kind, size)
            assert driver('parse ' + wire.hex()).startswith('%d:' % kind) == valid, (kind, size)


def test_speed_saturates(driver):
    for sent, taken in ((1000, 1000), (1001, 1000), (32767, 1000), (-1001, -1000), (-32768, -1000)):
        wire = cobs_encode(b'\x04' + struct.pack('<h', sent)) + b'\x00'
        assert '=%d ' % taken in driver('parse ' + wire.hex())


def test_bad_packets_are_counted_and_take_no_good_one_with_them(driver):
    good = '020b00'
    assert driver('parse 00 00 ' + good) == '11: | cobs=0 long=0 length=0 unknown=0 timeout=0'
    assert driver('parse 051122 00 ' + good).endswith('cobs=1 long=0 length=0 unknown=0 timeout=0')
    assert driver('parse 020d00 ' + good).endswith('cobs=0 long=0 length=0 unknown=1 timeout=0')
    assert driver('parse 03040100 ' + good).endswith('cobs=0 long=0 length=1 unknown=0 timeout=0')
    too_long = cobs_encode(b'\x01' + b'x' * 256) + b'\x00'
    for bad in ('051122 00', '020d00', '03040100', too_long.hex(), '11' * 2000 + '00'):
        assert driver('parse %s %s' % (bad, good)).startswith('11: |'), bad
    longest = cobs_encode(b'\x01' + b'x' * 255) + b'\x00'
    assert driver('parse ' + longest.hex()).startswith('1:' + '78' * 255)


def test_a_packet_without_its_end_is_given_up(driver):
    assert driver('parse 0404 +49 900100') == \
        '4:9001=400 | cobs=0 long=0 length=0 unknown=0 timeout=0'
    assert driver('parse 0404 +50 020b00') == '11: | cobs=0 long=0 length=0 unknown=0 timeout=1'


def test_the_time_in_a_packet_and_in_a_frame(driver):
    time = struct.pack('<I', 0x80FF0001)
    for count in 1, 16:
        packet = cobs_encode(b'\xfe' + time + bytes((count,))) + b'\0'
        assert driver(f'time packet {0x80FF0001} {count}') == packet.hex()
    frame = bytes.fromhex(driver(f'time frame {0x80FF0001}'))
    assert frame[:3] == b'\x02\x06\xfe' and frame[4:-2] == time
    assert frame[-1] == 3 and xor_of(frame[2:-1]) == 0


CUSTOM = struct.pack('<hBf', -300, 128, 1.5)


def test_a_custom_packed_struct_is_sent_and_taken_as_it_stands(driver):
    wire = cobs_encode(b'\x30' + CUSTOM) + b'\x00'
    assert driver('custom packet -300 128 1.5') == wire.hex()
    assert driver('parse ' + wire.hex()).startswith('48:%s=-300/128 |' % CUSTOM.hex())
    # Another length is none, and no other type has become known.
    for data, counted in ((b'\x30' + CUSTOM[:-1], 'length=1 unknown=0'),
                          (b'\x31' + CUSTOM, 'length=0 unknown=1')):
        answer = driver('parse ' + (cobs_encode(data) + b'\x00').hex())
        assert answer.startswith('|') and counted in answer


def test_a_custom_function_takes_and_answers_a_packed_struct(driver):
    def frame(head, data):
        return (head + data + bytes([xor_of(head + data)])).hex()

    asked = frame(b'\xa5\x07\x55\x30', CUSTOM)
    assert driver('bus a5000000a5 ' + asked).split()[1] == frame(b'\xa5\x07\x02', CUSTOM)
    asked = frame(b'\xa5\x06\x55\x30', CUSTOM[:-1])
    assert driver('bus a5000000a5 ' + asked).split()[1] == frame(b'\xa5\x02\x03', b'\x01\x80')


def test_a_custom_frame_carries_a_packed_struct(driver):
    wire = bytes.fromhex(driver('custom frame -300 128 1.5'))
    assert wire[:3] == b'\x02\x09\x30' and wire[4:-2] == CUSTOM
    assert wire[-1] == 3 and xor_of(wire[2:-1]) == 0


# robot-ctrl-bus

SYNC, SYNC_REPLY = 'a5000000a5', 'a50000a5'
LIFT_UP_100, OK = 'a50255200064b6', 'a50002a7'


def invalid(code):
    frame = bytes([0xA5, 1, 0xFF, code])
    return (frame + bytes([xor_of(frame)])).hex()


def bus(driver, *tokens):
    """The replies after each token, and what the board executed."""
    answer = driver('bus ' + ' '.join(tokens))
    replies, executed = answer.split('|')
    return replies.split(), executed.split()


EXPECTED = {
    'sync': SYNC_REPLY,
    'gimbal left 30 degrees': OK,
    'gimbal tilt down 90 degrees': OK,
    'environment, Datelen 0x02 as documented': 'a506025e01030acc1229',
    'environment, Datelen 0x00': 'a506025e01030acc1229',
}


@pytest.mark.parametrize('case', VECTORS['bus']['requests'], ids=lambda case: case['name'])
def test_bus_requests(driver, case):
    frame = plain(case['frame'])
    assert request(case['cmd1'], case['cmd2'], hexed(case['data'])).hex() == frame \
        or 'documented' in case['name']
    if case['name'].startswith('echo'):
        expected = reply_of(1, hexed(case['data'])).hex()
    else:
        expected = EXPECTED.get(case['name'], '-')  # a lift answers when it has ended
    one_by_one = [frame[i:i + 2] for i in range(0, len(frame), 2)]
    assert bus(driver, SYNC, frame)[0] == [SYNC_REPLY, expected]
    replies, executed = bus(driver, SYNC, *one_by_one)
    assert replies == [SYNC_REPLY] + ['-'] * (len(one_by_one) - 1) + [expected]
    if case['cmd1'] == 0x55:
        assert executed == ['%02x:%s' % (case['cmd2'], plain(case['data']))]


def reply_of(cmd1, data=b''):
    return bus_frame(bytes([cmd1]), data)


@pytest.mark.parametrize('case', VECTORS['bus']['replies'], ids=lambda case: case['name'])
def test_bus_replies(driver, case):
    """Each reply of the examples that this board can be brought to give."""
    frame = plain(case['frame'])
    assert reply_of(case['cmd1'], hexed(case['data'])).hex() == frame
    provoke = {
        'sync': [SYNC],
        'ok': [SYNC, request(0x55, 0x21, b'\x00\x1e').hex()],
        'ok with environment: smoke 350, 25.63 C, 48.12 %': [SYNC, 'a5025522d0'],
        'error 0x8000: unsupported command': [SYNC, request(0x55, 0x77).hex()],
        'error 0x8001: malformed data': [SYNC, request(0x55, 0x21, b'\x04\x1e').hex()],
        'invalid 0x40: checksum mismatch': [SYNC, 'a50255200064b7', '+5'],
        'invalid 0x20: too long': [SYNC, '5a2d01' + '0100', '+5'],
        'invalid 0x10: not synchronised': [LIFT_UP_100],
    }
    if case['name'].startswith('echo'):
        provoke[case['name']] = [SYNC, request(1, 0, hexed(case['data'])).hex()]
    if case['name'] in provoke:
        assert bus(driver, *provoke[case['name']])[0][-1] == frame
    else:
        assert case['error'] == 0x8002 if 'error' in case else 'smoke 65535' in case['name']


def test_bus_executes_nothing_before_sync(driver):
    replies, executed = bus(driver, LIFT_UP_100, request(1, 0, b'x').hex(),
                            request(0x55, 0x22).hex())
    assert replies == [invalid(0x10)] * 3
    assert executed == []


def test_bus_motion_takes_its_time_and_everything_waits_for_it(driver):
    echo = request(1, 0, b'\xde\xad').hex()
    replies, executed = bus(driver, SYNC, LIFT_UP_100, '+3000', echo, SYNC, '!', LIFT_UP_100, '!')
    assert replies == [SYNC_REPLY, '-', '-', '-', '-',
                       OK + reply_of(1, b'\xde\xad').hex() + SYNC_REPLY, '-', OK]
    assert executed == ['20:0064'] * 2


STOP, UNSUPPORTED = request(0x55, 0x2F).hex(), reply_of(3, b'\x00\x80').hex()


@pytest.mark.parametrize('moving', [False, True])
def test_bus_finds_a_stop_that_is_under_way_when_a_false_start_is_given_up(driver, moving):
    before = [SYNC] + [LIFT_UP_100] * moving + ['5a2c01']
    for count in range(12):
        slow = ['+10', '00'] * count
        replies, executed = bus(driver, *before, *slow, STOP[:4], '+20', STOP[4:],
                                *['+10', '00'] * 9)
        assert (OK + UNSUPPORTED if moving else UNSUPPORTED) in replies, count
        assert executed == ['20:0064'] * moving + ['2f:']


def test_bus_rejects(driver):
    for case in VECTORS['bus']['rejected']:
        assert bus(driver, SYNC, plain(case['frame']), '+60')[1] == []


class SlaveModel:
    """What the Slave makes of one burst of bytes with silence after it."""

    MAX_DATA = 300

    def __init__(self):
        self.executed = []

    def burst(self, data):
        replies = b''
        code = None
        at = 0
        while at < len(data):
            size, verdict = self.frame(data[at:])
            if verdict == 'ok':
                replies += self.execute(data[at:at + size])
                code = None
                at += size
                continue
            if verdict in (0x40, 0x20) and code is None:
                code = verdict
            at += 1
        return replies + (bytes.fromhex(invalid(code)) if code else b'')

    def frame(self, data):
        """Length and verdict of what begins here: ok, an INVALID code, or None for nothing."""
        if data[0] not in (0xA5, 0x5A):
            return 1, None
        header = 5 if data[0] == 0x5A else 4
        if len(data) < header - 2:
            return 1, None
        length = struct.unpack_from('<H', data, 1)[0] if header == 5 else data[1]
        if (length < 255) if header == 5 else (length == 255):
            return 1, None
        if length > self.MAX_DATA:
            return 1, 0x20
        if data[:4] == b'\xa5\x02\x55\x22' and data[4:5] == b'\xd0':
            return 5, 'ok'
        end = header + length
        if len(data) <= end:
            return 1, None
        return (end + 1, 'ok') if xor_of(data[:end]) == data[end] else (1, 0x40)

    def execute(self, frame):
        header = 5 if frame[0] == 0x5A else 4
        cmd1, cmd2, data = frame[header - 2], frame[header - 1], frame[header:-1]
        if cmd1 == 0:
            return reply_of(0)
        if cmd1 == 1:
            return reply_of(1, data)
        if cmd1 != 0x55:
            return reply_of(3, b'\x00\x80')
        self.executed.append('%02x:%s' % (cmd2, data.hex()))
        if cmd2 == 0x22:
            return reply_of(2, struct.pack('<HhH', 350, 2563, 4812))
        if cmd2 == 0x21:
            return reply_of(2) if len(data) == 2 and data[0] <= 3 else reply_of(3, b'\x01\x80')
        return reply_of(3, b'\x00\x80')


def random_burst(rng):
    burst = b''
    for _ in range(rng.randrange(1, 4)):
        kind = rng.randrange(6)
        size = rng.choice([0, 1, 2, 2, 3, 7, 60, 255, 256, 299])
        data = bytes(rng.choice([0xA5, 0x5A, 0, 1, rng.randrange(256)]) for _ in range(size))
        frame = request(rng.choice([0, 1, 0x55, 0x55, 0x55, 9]),
                        rng.choice([0x21, 0x21, 0x22, 0x23]), data)
        if kind == 0:
            frame = bytes(rng.choice([0xA5, 0x5A, 0, 2, 0x55, 0x22, rng.randrange(256)])
                          for _ in range(rng.randrange(12)))
        elif kind == 1 and frame:
            at = rng.randrange(len(frame))
            frame = frame[:at] + bytes([frame[at] ^ (1 << rng.randrange(8))]) + frame[at + 1:]
        elif kind == 2:
            frame = frame[: rng.randrange(len(frame) + 1)]
        elif kind == 3:
            frame = hexed('a5025522d0')
        # The model knows no motions.
        burst += frame.replace(b'\x55\x20', b'\x55\x21')
    return burst


def test_bus_agrees_with_the_model(driver):
    rng = random.Random(2)
    for _ in range(1500):
        model = SlaveModel()
        expected = [SYNC_REPLY]
        tokens = [SYNC]
        for _ in range(4):
            burst = random_burst(rng)
            if not burst or b'\x55\x20' in burst:
                continue
            cut = rng.randrange(1, len(burst) + 1)
            tokens += [chunk.hex() for chunk in (burst[:cut], burst[cut:]) if chunk] + ['+60']
            expected.append(model.burst(burst).hex())
        replies, executed = bus(driver, *(tokens[:1] + ['+60'] + tokens[1:]))
        assert ''.join(reply for reply in replies if reply != '-') == ''.join(expected), tokens
        assert executed == model.executed, tokens


# STX/ETX


@pytest.mark.parametrize(
    'case', VECTORS['mcu']['frames'], ids=lambda case: '%d-%d' % (case['type'], case['seq'])
)
def test_stx_etx_frames(driver, case):
    if case['seq']:
        assert driver('skip %d' % case['seq']) == 'ok'
    value = case['value']
    if case['type'] == 0x10:
        command = 'sensor %d %d %d %d %d' % (
            value['vl53_1'], value['vl53_2'],
            *(round(value[angle] * 100) for angle in ('yaw', 'pitch', 'roll')))
    else:
        command = 'adc ' + ' '.join(str(channel) for channel in value['adc'])
    assert driver(command) == plain(case['frame'])


def test_stx_etx_sequence_counts_modulo_256(driver):
    sequence = [hexed(driver('adc 1 2 3 4 5 6'))[3] for _ in range(300)]
    assert sequence == [number % 256 for number in range(300)]


def test_heading_wraps_and_can_be_restored(driver):
    for heading in range(0, 36000, 25):
        frame = hexed(driver('sensor 1 2 %d 0 0' % heading))
        yaw = struct.unpack_from('<h', frame, 8)[0]
        assert (yaw + 65536 if yaw < -18000 else yaw) == heading


# The heartbeat watch


def test_heartbeat_watch_agrees_with_the_model(driver):
    rng = random.Random(3)
    for _ in range(100):
        tokens, expected = [], ''
        arrivals = []    # at which tick each byte that waits has come
        now, age = 0, 31
        for _ in range(300):
            count = min(rng.randrange(13), 63 - len(arrivals))
            arrivals += [now] * count
            tokens.append('a%d' % count)
            while arrivals and rng.random() < 0.95:
                arrived = arrivals.pop(0)
                tokens.append('r1')
                if rng.random() < 0.02:
                    age = min(age, now - arrived)
                    tokens.append('h1')
            ticks = rng.choice([1, 1, 1, 1, 1, 1, 1, 2, 5, 33, 60])
            tokens.append('t%d' % ticks)
            for _ in range(ticks):
                now, age = now + 1, age + 1
                expected += '1' if age < 31 else '0'
        assert driver('watch ' + ' '.join(tokens)) == expected
        assert '1' in expected and '0' in expected
