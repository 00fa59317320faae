"""The statistical part: damage that makes no valid frame, and the checks."""
import random
import struct
import time
from types import SimpleNamespace

import by_definition as codec
import pytest

pytest.importorskip('rospy')
from campaign import storm_checks  # noqa: E402
from campaign.boards import MEMORY, Fence, Packet, Request  # noqa: E402
from campaign.damage import DamagedLine  # noqa: E402
from campaign.requirements import Table  # noqa: E402
from campaign.rig import FENCED  # noqa: E402
from campaign.robot import NOT_SENT, TIMEOUT, Outcome, Published  # noqa: E402

TOKEN = struct.pack('<I', 7)


def frames(frame_at, rand):
    """Random frames of a link."""
    while True:
        data = bytes(rand.choice((0xA5, 0x5A, 2, 3, 0, rand.randrange(256)))
                     for _ in range(rand.randrange(1, 12)))
        yield {codec.mcu_at: codec.mcu_frame(0x20, rand.randrange(256), data),
               codec.reply_at: codec.bus_frame(b'\2', data),
               codec.request_at: codec.bus_frame(b'\x55\xf0', data),
               codec.arduino_at: codec.arduino_packet(60, data[:4].ljust(4))}[frame_at]


@pytest.mark.parametrize('frame_at', [codec.mcu_at, codec.reply_at, codec.request_at,
                                      codec.arduino_at])
def test_no_valid_frame_that_was_not_sent_is_on_the_line(frame_at):
    """Whatever a decoder does with incomplete frames, all that it finds was sent."""
    rand = random.Random(5)
    line, source = DamagedLine(frame_at, rand, 0.3), frames(frame_at, rand)
    received, intact = b'', set()
    for _ in range(600):
        data = next(source)
        arrived = line.pass_on(data)
        if arrived == data:
            intact.add((len(received), len(received) + len(data)))
        received += arrived
    assert line.damaged > 100 and len(intact) > 300
    if frame_at is codec.arduino_at:
        found = [frame for frame in codec.decode(received, frame_at)[0]
                 if frame.type == 60 and len(frame.data) == 4]
    else:
        found = codec.all_frames(received, frame_at)
    for frame in found:
        assert any(start <= frame.start and frame.end <= end for start, end in intact)
    assert len(found) > 200


@pytest.mark.parametrize('given_up', [0, 1, 2])
def test_a_packet_of_the_car_whose_beginning_was_given_up_is_no_foreign_one(given_up):
    """A decoder that has given up some of the damaged packets finds none in what follows."""
    for seed in range(300):
        rand = random.Random(seed)
        line = DamagedLine(codec.arduino_at, rand, 0.8)
        sent = [codec.arduino_packet(60, struct.pack('<I', number)) for number in range(4)]
        arrived = [line.pass_on(data) for data in sent]
        found = codec.decode(b''.join(arrived[given_up:]), codec.arduino_at)[0]
        whole = [number for number in range(4) if arrived[number] == sent[number]]
        assert {struct.unpack('<I', frame.data)[0] for frame in found
                if frame.type == 60 and len(frame.data) == 4} <= set(whole)


class FakeRig:
    """Has what the checks use of a rig."""

    def __init__(self):
        self.table = Table()
        self.table.part = 'storm'
        self.row, self.late, self.is_network = self.table.row, 0.0, False
        self.robot = SimpleNamespace(command=lambda name, value, stamp: None)
        self.violated = []
        self.table.on_violation.append(lambda text, _example: self.violated.append(text))
        self.machine = SimpleNamespace(stalled=lambda since, until: self.late >= 0.1)

    def in_time(self, required, since, until, limit, text):
        if self.late:
            required.undecided += 1
        else:
            required.at_most(until - since, limit, 's', text)


@pytest.fixture
def rig():
    return FakeRig()


@pytest.fixture
def motor(rig):
    """The port is open, and 300 was commanded at 100.0."""
    motor = storm_checks.MotorCheck(rig)
    motor.received(speed(0, 100.0))
    motor._commands[300] = 100.0
    motor.received(speed(300, 100.0))
    return motor


def speed(value, t, beats=0):
    return Packet(t, codec.SPEED, struct.pack('<h', value), beats)


def test_stop_in_time(rig, motor):
    for index in range(54):
        motor.heartbeat(100.0 + index / 100)
    motor.received(speed(0, 100.545))
    motor.heartbeat(102.0)
    motor.judge()
    assert rig.violated == []


@pytest.mark.parametrize('late', [0.0, 0.1])
def test_no_stop(rig, motor, late):
    rig.late = late
    motor.heartbeat(100.56)
    motor.heartbeat(100.57)
    motor.judge()
    row = rig.row('SPEED 0 within speed_timeout + 50 ms of the last command')
    assert (row.violations, row.undecided) == ((0, 1) if late else (1, 0))


@pytest.mark.parametrize('first', [speed(300, 1.0), speed(0, 1.0, beats=1)])
def test_first_packet_of_a_connection_is_not_speed_0(rig, motor, first):
    motor._commands[300] = 1.0
    motor.start_connection()
    motor.received(first)
    assert rig.violated == ['SPEED 0 is the first packet whenever the port opens']


def test_speeds_that_were_not_commanded_or_are_old(rig, motor):
    motor.received(speed(300, 100.1))       # once more
    motor.received(speed(302, 100.1))
    assert rig.violated == ['every SPEED was commanded, and is sent once'] * 2
    motor.received(speed(0, 100.2))
    motor._commands[301] = 100.2
    motor.received(speed(301, 101.0))
    motor.judge()
    assert rig.violated[2:] == ['no SPEED over 0.7 s after its command, 1.5 s behind socket://']


@pytest.mark.parametrize('outcome, executed, violated', [
    (Outcome(True, 2, '', TOKEN), 1, ''), (Outcome(True, 2, '', TOKEN), 0, 'done'),
    (Outcome(True, 2, '', TOKEN), 2, 'done'), (Outcome(False, 3, ''), 0, ''),
    (Outcome(False, 3, ''), 1, 'refused'), (Outcome(False, NOT_SENT, ''), 1, 'refused'),
    (Outcome(False, TIMEOUT, ''), 1, ''), (Outcome(False, TIMEOUT, ''), 2, 'not known'),
    (Outcome(True, 2, '', b'else'), 1, 'its own reply'),
    (Outcome(False, None, 'error'), 0, 'returns')])
def test_outcome_of_a_call(rig, outcome, executed, violated):
    calls = storm_checks.CallCheck(rig)
    calls.executed[MEMORY, TOKEN] = executed
    calls.check((MEMORY, TOKEN), outcome)
    assert len(rig.violated) == bool(violated)
    assert all(violated in text for text in rig.violated)


def test_requests_that_belong_to_no_call_or_come_again(rig):
    calls, request = storm_checks.CallCheck(rig), Request(1.0, codec.FUNCTION, MEMORY, TOKEN, 0)
    calls._expected[request.key] = 1
    calls.received(request)
    calls.received(request._replace(cmd1=codec.ECHO))
    calls.received(request._replace(cmd2=codec.ENVIRONMENT, data=b''))
    assert rig.violated == []
    calls.received(request)
    assert rig.violated == ['a request comes again only after INVALID']
    calls._expected[request.key] = 0
    calls.invalid(request.key)
    calls.received(request)
    del calls._expected[request.key]
    calls.received(request)
    assert rig.violated[1:] == ['every request belongs to a call that waits, or to a poll']


class Values:
    """A ValueCheck to which `sent` values were sent, each 0.1 s after the one before."""

    def __init__(self, rig, sent, must=True):
        self.check, self.rig, self.began = storm_checks.ValueCheck(rig), rig, time.monotonic()
        for number in range(sent):
            self.check.sent([('~counter', number)], must)
        waiting = self.check._waiting['~counter']
        for index, value in enumerate(list(waiting)):
            waiting[index] = value._replace(at=self.began + index / 10)

    def publish(self, *numbers):
        for number in numbers:
            self.check.published('~counter', Published(0.0, 0.0, number, None))
        self.check.judge()
        return self.rig.violated

    def disturb(self, link, since, until):
        disturbance = storm_checks.Disturbance(link)
        disturbance.since, disturbance.until = self.began + since, self.began + until
        self.check.disturbances.append(disturbance)


CORRECT = 'every published value was in a valid frame, in order, once'
LOST = 'values are lost only in a stall or reconnect, until the next one'


@pytest.mark.parametrize('published, violated', [
    ((0, 1, 2), []), ((0, 1, 1, 2), [CORRECT]), ((0, 2, 1), [CORRECT, LOST]),
    ((0, 1, 99), [CORRECT]), ((0, 2), [LOST])])
def test_published_values(rig, published, violated):
    assert Values(rig, 3).publish(*published) == violated


@pytest.mark.parametrize('topic, before, violated', [
    ('~height', True, False), ('~height', False, True), ('~counter', True, True)])
def test_a_polled_value_from_before_the_storm(rig, topic, before, violated):
    check = storm_checks.ValueCheck(rig)
    check.sent([(topic, 8)], True)
    for number in (7, 8) if before else (8, 7):
        check.published(topic, Published(0.0, 0.0, number, None))
    assert rig.violated == [CORRECT] * violated


def test_a_value_that_need_not_be_published(rig):
    assert Values(rig, 3, must=False).publish(0, 2) == []


def test_a_value_that_is_never_published(rig, monkeypatch):
    values = Values(rig, 3)
    assert values.publish(0, 1) == []
    monkeypatch.setattr(storm_checks, '_KEPT', -1.0)
    assert values.publish() == [LOST] and not values.check._waiting['~counter']


@pytest.mark.parametrize('link, late, violated', [
    ('arduino', 0.0, 0), ('', 0.0, 0), ('mcu', 0.0, 1), ('mcu', 0.09, 1), ('mcu', 0.1, 0)])
def test_values_may_be_lost_in_a_disturbance_or_if_a_witness_was_as_late(rig, link, late, violated):
    values, rig.late = Values(rig, 12), late
    values.disturb(link, 0.5, 0.9)
    assert len(values.publish(*range(6), *range(7, 12))) == violated    # sent at 0.6


@pytest.mark.parametrize('holds, late', [(True, 0.0), (False, 0.0), (False, 0.1), (True, 0.1)])
def test_a_request_without_a_fence_is_not_decided_if_the_machine_stalled(rig, holds, late):
    rig.late = late
    check = storm_checks.CallCheck(rig)
    check.fences.append(Fence(100.0, holds, ''))
    check.judge()
    row = rig.row(FENCED)
    assert (row.checks, row.violations, row.undecided) == (
        (0, 0, 1) if late and not holds else (1, int(not holds), 0))


def test_after_a_disturbance_values_may_be_lost_only_until_the_next_one(rig):
    values = Values(rig, 20)
    values.disturb('arduino', 0.45, 0.85)
    assert values.publish(0, 1, 2, 3, 4, 12, 13) == []
    assert values.publish(15) == [LOST]


@pytest.mark.parametrize('first, second, violated', [
    ((50, 50.1, 90), (9, 50.9, 50.8), []), ((50, 50.1, 90), (9, 51.2, 60), ['memory']),
    ((50, 44, 38), (44, 44, 50), []), ((50, 50, 44), (61.5, 61.5, 55.5), ['memory', 'files']),
    ((50, 50), (), ['memory', 'threads', 'files'])])
def test_growth_between_the_halves(rig, monkeypatch, first, second, violated):
    """A closed port has six files less, and a call that is under way has more."""
    rig.child_bridge, now = SimpleNamespace(pid=1), [0.0]
    monkeypatch.setattr(storm_checks.time, 'monotonic', lambda: now[0])
    check = storm_checks.GrowthCheck(rig, 90.0)
    for at, values in (0, (9.0,)), (40, first), (70, second):
        for now[0], value in enumerate(values, at):
            monkeypatch.setattr(storm_checks, 'usage_of', lambda pid: {
                'memory': value, 'threads': 9, 'files': value})
            check.measure()
    check.judge()
    assert rig.violated == [f'no growth: {name}' for name in violated]
    assert rig.row('no growth: memory').checks == len(second) + 1
