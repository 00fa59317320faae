"""What has to be published for what a journal says was on the wire."""
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from campaign.expected import TOPICS, arrivals, expected
from campaign.records import Intervals

TICKS = next(topic for topic in TOPICS if topic.name.endswith('/ticks'))
STATUS = next(topic for topic in TOPICS if topic.name == '/mcu/status')


def packet(t, value, **more):
    return dict({'t': t, 'ev': 'tx', 'n': 1, 'type': 8, 'data': '%02x' % value, 'ok': True},
                **more)


def ticks(*journal, exempt=()):
    frames = arrivals(list(journal), 'arduino')
    return [(one.key, one.must, one.kind)
            for one in expected(frames, TICKS.sent, True, Intervals(exempt))]


def test_a_packet():
    assert ticks(packet(1.0, 7)) == [(7, True, 'ok')]


def test_one_that_never_left():
    assert ticks(packet(1.0, 7, ok=False, sent=False)) == []


def test_one_that_came_twice():
    assert ticks(packet(1.0, 7, copies=2)) == [(7, True, 'ok')] * 2


def test_one_around_a_ports_absence():
    assert ticks(packet(1.0, 7), exempt=[(0.9, 1.1)]) == [(7, False, 'ok')]


def test_damage_that_nobody_can_see():
    assert ticks(packet(1.0, 7, ok=False, wire='03080900')) == [
        (7, False, 'maybe'), (9, False, 'blind')]


def test_damage_that_everybody_can_see():
    assert ticks(packet(1.0, 7, ok=False, wire='090807')) == [(7, False, 'maybe')]


def test_a_packet_behind_one_without_an_end():
    """03 08 and then 03 08 07 00: a packet of five bytes, or the second one alone."""
    found = ticks(packet(1.0, 5, ok=False, wire='0308'), packet(1.01, 7, ok=False))
    assert found == [(5, False, 'maybe'), (7, False, 'maybe')]
    joined = ticks(packet(1.0, 5, ok=False, wire='03'), packet(1.01, 8, ok=False, wire='080800'))
    assert (8, False, 'blind') not in joined and (8, False, 'maybe') in joined


def test_a_packet_that_came_twice_behind_one_without_an_end():
    """The first of the two ends the one before it: an IMU packet of the right length, then it."""
    cut = packet(1.0, 0, type=9, data='2592000a008333cfffff00010030fca005bf1fb9f9c2', ok=False,
                 wire='04092592020a068333cfffff02010a30fca005bf1f')
    frames = arrivals([cut, packet(1.01, 3, ok=False, copies=2)], 'arduino')
    assert [one.key[0] for one in expected(frames, lambda own: own, True, Intervals())] == [
        9, 8, 9, 8]


def test_noise_that_came_before_a_packet_which_the_records_have_before_it():
    noise = {'t': 1.0001, 'ev': 'chatter', 'wire': '0202'}
    frames = arrivals([packet(1.0, 7), noise, packet(1.01, 9)], 'arduino')
    joined, = arduino.Decoder().feed(bytes.fromhex('0202' + '03080700'))
    assert not joined.cause and (joined.type, 0, joined.data) in frames[0].made


def test_a_frame_in_noise_that_came_before_a_frame_which_the_records_have_before_it():
    noise = {'t': 1.0001, 'ev': 'chatter', 'wire': 'a5020200000003'}
    frames = arrivals([status(1.0, 5), noise, status(1.05, 6)], 'mcu')
    keys = [one.key[:2] for one in expected(frames, lambda own: own, True, Intervals())]
    assert keys[:2] == [(0, 0), (16, 5)]


def status(t, seq, **more):
    message = mcu.SensorStatus(100 + seq, 200, 12.34, 1.0, 2.0)
    return dict({'t': t, 'ev': 'tx', 'n': seq, 'type': 16, 'seq': seq, 'ok': True,
                 'raw': mcu.encode(message, seq).hex()}, **more)


def statuses(*journal):
    frames = arrivals(list(journal), 'mcu')
    return [(one.key[0], one.must, one.kind)
            for one in expected(frames, STATUS.sent, False, Intervals())]


def test_a_doubled_frame_is_published_once():
    assert statuses(status(1.0, 5, copies=2)) == [(5, True, 'ok')]


def test_a_damaged_frame():
    wire = bytearray.fromhex(status(1.0, 5)['raw'])
    wire[5] ^= 1
    assert statuses(status(1.0, 5, ok=False, wire=wire.hex())) == [(5, False, 'maybe')]


def test_a_damaged_frame_whose_xor_fits():
    wire = bytearray.fromhex(status(1.0, 5)['raw'])
    wire[5] ^= 1
    wire[7] ^= 1
    assert [kind for _key, _must, kind in statuses(
        status(1.0, 5, ok=False, wire=wire.hex()))] == ['maybe', 'blind']


def test_frames_that_a_false_start_held_back_must_still_come():
    noise = {'t': 0.99, 'ev': 'chatter', 'wire': '02ff'}
    assert statuses(noise, status(1.0, 5), status(1.05, 6)) == [(5, True, 'ok'), (6, True, 'ok')]


def test_noise_that_is_the_frame_before_once_more():
    noise = {'t': 1.5, 'ev': 'chatter', 'wire': status(1.0, 9)['raw']}
    assert statuses(status(1.0, 9), noise) == [(9, True, 'ok'), (9, False, 'blind')]


def test_a_frame_in_noise():
    noise = {'t': 0.99, 'ev': 'chatter', 'wire': '02a5' + status(1.0, 9)['raw']}
    assert (9, False, 'blind') in statuses(noise)


def test_a_good_frame_of_which_damage_made_another():
    """The rest of a frame, then a whole one; the XOR over both fits: both may be gone."""
    second = bytes.fromhex(status(1.05, 6)['raw'])
    rest = bytearray(b'\x02\x0c\x10\x05\x01\x01\x01\x01')
    body = rest[2:] + second
    body = body[:12]
    fill = 0
    for byte in body:
        fill ^= byte
    # CRC and ETX of the joint frame would stand at bytes 6 and 7 of the second one.
    joint = bytes(rest) + second[:6]
    assert len(joint) == 14
    first = status(1.0, 5, ok=False, wire=bytes(rest).hex())
    changed = bytearray(second)
    changed[6], changed[7] = fill, 0x03
    changed[14] ^= second[6] ^ fill ^ second[7] ^ 0x03
    assert mcu.Decoder().feed(bytes(changed))[0].message
    found = statuses(first, status(1.05, 6, raw=bytes(changed).hex()))
    assert (6, True, 'ok') not in found and (6, False, 'maybe') in found
    assert (5, False, 'blind') in found


def test_values_are_turned_back_into_the_boards():
    from sensor_msgs.msg import Imu
    topic = next(topic for topic in TOPICS if topic.name.endswith('communication/imu'))
    sent = arduino.Imu(16384, 1, -2, 3, 4, -5, 6, 700, -800, 900, 10)
    out = Imu()
    (out.orientation.x, out.orientation.y, out.orientation.z,
     out.orientation.w) = sent.orientation()
    (out.angular_velocity.x, out.angular_velocity.y,
     out.angular_velocity.z) = sent.angular_velocity()
    (out.linear_acceleration.x, out.linear_acceleration.y,
     out.linear_acceleration.z) = sent.linear_acceleration()
    assert topic.published(out) == topic.sent((9, 0, sent.pack()))
    out.orientation.y = -out.orientation.y
    assert topic.published(out) != topic.sent((9, 0, sent.pack()))
    out.orientation.y = -out.orientation.y
    out.linear_acceleration.z *= 1.0001
    assert topic.published(out) != topic.sent((9, 0, sent.pack()))


def test_replies_of_the_bus():
    raw = bus.encode_reply(bus.Reply(bus.OK)).hex()
    entry = {'t': 1.0, 'ev': 'tx', 'n': 1, 'k': 1, 'raw': raw, 'ok': True}
    assert [frame.own for frame in arrivals([entry], 'bus')] == [(2, 0, b'')]


AIR = next(topic for topic in TOPICS if topic.name.endswith('/environment'))
REPLY = {'ev': 'tx', 'n': 1, 'ok': True,
         'raw': bus.encode_reply(bus.Reply(bus.OK, bytes.fromhex('8200c800c201'))).hex()}


def readings(*journal):
    return [(one.t, one.kind) for one in expected(
        arrivals(list(journal), 'bus'), AIR.sent, True, Intervals())]


def test_a_reading_whose_reply_was_copied_later_may_be_published_twice():
    copied = dict(REPLY, t=1.0, copies=2)
    assert readings(copied, {'t': 1.02, 'ev': 'copy', 'n': 1}) == [(1.0, 'ok'), (1.02, 'ok')]
    assert readings(dict(REPLY, t=1.0)) == [(1.0, 'ok')]


def test_a_copy_that_did_not_leave():
    copied = dict(REPLY, t=1.0, copies=2)
    lost = {'t': 1.02, 'ev': 'copy', 'n': 1, 'sent': False, 'why': 'closed'}
    assert readings(copied, lost) == [(1.0, 'ok')]


def test_a_copy_of_a_reply_that_did_not_leave_itself():
    first = dict(REPLY, t=1.0, copies=2, ok=False, sent=False, why='closed')
    assert readings(first, {'t': 1.02, 'ev': 'copy', 'n': 1}) == [(1.02, 'maybe')]


def test_noise_between_the_bridges_opening_of_its_port_and_the_boards():
    noise, opened = {'t': 1.0, 'ev': 'chatter', 'wire': '0202'}, {'t': 1.045, 'ev': 'port'}
    frames = arrivals([noise, opened, packet(1.0496, 0)], 'arduino')
    assert (2, 0, b'\0\x08\0') in [made for one in frames for made in one.made]
