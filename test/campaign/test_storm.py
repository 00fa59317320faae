"""The statistical part: damage that makes no valid frame, and the checks."""
import random
import struct
import time
from types import SimpleNamespace

import by_definition as codec
import pytest

pytest.importorskip('rospy')
from campaign import storm  # noqa: E402
from campaign.boards import MEMORY, Packet, Request, car_keys  # noqa: E402
from campaign.requirements import Table  # noqa: E402
from campaign.robot import NOT_SENT, TIMEOUT, Outcome, Published  # noqa: E402

TOKEN = struct.pack('<I', 7)


def frames(link, rand):
    """Random frames of a link."""
    while True:
        data = bytes(rand.choice((0xA5, 0x5A, 2, 3, 0, rand.randrange(256)))
                     for _ in range(rand.randrange(1, 12)))
        if link is codec.mcu_at:
            yield codec.mcu_frame(0x20, rand.randrange(256), data)
        elif link is codec.reply_at:
            yield codec.bus_frame(b'\2', data)
        elif link is codec.request_at:
            yield codec.bus_frame(b'\x55\xf0', data)
        else:
            yield codec.arduino_packet(60, data[:4].ljust(4))


@pytest.mark.parametrize('frame_at', [codec.mcu_at, codec.reply_at, codec.request_at,
                                      codec.arduino_at])
def test_no_valid_frame_that_was_not_sent_is_on_the_line(frame_at):
    """Whatever a decoder does with incomplete frames, all that it finds was sent."""
    rand = random.Random(5)
    stream = storm.Stream(frame_at, rand, 0.3)
    received, intact, source = b'', set(), frames(frame_at, rand)
    for _ in range(600):
        data = next(source)
        arrived = stream.pass_on(data)
        if arrived == data:
            intact.add((len(received), len(received) + len(data)))
        received += arrived
    assert stream.damaged > 100 and len(intact) > 300
    if frame_at is codec.arduino_at:
        found = codec.decode(received, frame_at)[0]
        found = [frame for frame in found if len(frame.data) == 4 and frame.type == 60]
    else:
        found = codec.all_frames(received, frame_at)
    for frame in found:
        assert any(start <= frame.start and frame.end <= end for start, end in intact)
    assert len(found) > 200


class FakeStorm:
    """Has what the checks use of a Storm."""

    def __init__(self):
        self.table = Table()
        self.lock, self.disturbed, self.late = storm.threading.RLock(), [], 0.0
        self.rig = SimpleNamespace(
            row=self.table.row, bus=SimpleNamespace(connection=1),
            excuses=lambda since, until, seconds: self.late > seconds,
            longest_delay=lambda since, until: self.late,
            robot=SimpleNamespace(command=lambda name, value, stamp: None))
        self.violated = []

        self.table.on_violation = lambda requirement, text: self.violated.append(requirement)

    def record(self, *what):
        pass


@pytest.fixture
def fake():
    return FakeStorm()


@pytest.fixture
def motor(fake):
    return storm.MotorCheck(fake)


def speed(value, t, beats=0):
    return Packet(t, codec.SPEED, struct.pack('<h', value), beats, 0)


def test_stop_in_time(fake, motor):
    motor.received(speed(0, 100.0))
    motor._commands[300] = 100.0
    motor.received(speed(300, 100.0))
    for index in range(54):
        motor.check_stop(100.0 + index / 100)
    motor.received(speed(0, 100.545))
    motor.check_stop(102.0)
    assert fake.violated == []


def test_no_stop(fake, motor):
    motor.received(speed(0, 100.0))
    motor._commands[300] = 100.0
    motor.received(speed(300, 100.0))
    fake.late = 0.1
    motor.check_stop(100.56)
    assert fake.violated == []
    fake.late = 0.0
    motor.check_stop(100.57)
    assert fake.violated == ['storm: SPEED 0 within speed_timeout + 50 ms']


@pytest.mark.parametrize('first', [speed(300, 1.0), speed(0, 1.0, beats=1)])
def test_first_packet_of_a_connection_is_not_speed_0(fake, motor, first):
    motor._commands[300] = 1.0
    motor.received(first)
    assert fake.violated == ['storm: SPEED 0 is the first packet whenever the port opens']


def test_speeds_that_were_not_commanded_or_are_old(fake, motor):
    motor.received(speed(0, 1.0))
    motor._commands.update({300: 1.0, 301: 1.0})
    motor.received(speed(300, 1.1))
    assert fake.violated == []
    motor.received(speed(300, 1.1))
    motor.received(speed(302, 1.1))
    assert fake.violated == ['every SPEED was commanded, and is sent once'] * 2
    motor.received(speed(0, 1.2))
    motor.received(speed(301, 1.9))
    assert fake.violated[2:] == ['no SPEED over 0.7 s after its command']


@pytest.mark.parametrize('outcome, executed, violated', [
    (Outcome(True, 2, 0.1, '', TOKEN), 1, ''), (Outcome(True, 2, 0.1, '', TOKEN), 0, 'done'),
    (Outcome(True, 2, 0.1, '', TOKEN), 2, 'done'), (Outcome(False, 3, 0.1, ''), 0, ''),
    (Outcome(False, 3, 0.1, ''), 1, 'refused'), (Outcome(False, NOT_SENT, 0.1, ''), 1, 'refused'),
    (Outcome(False, TIMEOUT, 0.1, ''), 1, ''), (Outcome(False, TIMEOUT, 0.1, ''), 2, 'not known'),
    (Outcome(True, 2, 0.1, '', b'else'), 1, 'its own reply')])
def test_outcome_of_a_call(fake, outcome, executed, violated):
    calls = storm.CallCheck(fake)
    key = MEMORY, TOKEN
    calls.executed[key] = executed
    calls.check(key, outcome)
    assert bool(fake.violated) == bool(violated)
    assert all(violated in text for text in fake.violated)


def test_requests_that_belong_to_no_call_or_come_again(fake):
    calls, request = storm.CallCheck(fake), Request(1.0, codec.FUNCTION, MEMORY, TOKEN, 0)
    calls._waiting[request.key] = 1
    calls.received(request)
    calls.received(request._replace(cmd1=codec.ECHO))
    assert fake.violated == []
    calls.received(request)
    assert fake.violated == ['a request comes again only after INVALID']
    calls.invalid()
    calls.received(request)
    del calls._waiting[request.key]
    calls.received(request)
    assert fake.violated[1:] == ['every request belongs to a call that waits, or to a poll']


def test_published_values(fake):
    values, now = storm.ValueCheck(fake), time.monotonic()

    def publish(number):
        values.published('~counter', Published(0.0, 0.0, number, None))

    for number in range(1, 8):
        packet = codec.arduino_packet(60, struct.pack('<I', number))
        values.sent(codec.decode(packet, codec.arduino_at)[0][0], car_keys, number != 2)
    for number in (1, 3, 4):        # 2 could not be found
        publish(number)
    assert fake.violated == []
    publish(4)
    publish(9)
    assert fake.violated == ['every published value was in a valid frame, in order, once'] * 2
    publish(6)
    assert fake.violated[2:] == ['values are lost only beside a stall or a reconnect']
    fake.disturbed.append(('arduino', now, now + 1.0))
    values._waiting['~counter'][0] = (7, now - storm._KEPT - 1.0, True)
    values.check_old()
    assert len(fake.violated) == 4 and not values._waiting['~counter']
