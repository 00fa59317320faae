"""The checks of the statistical part: what is a violation and what is not."""
import struct
import time
from types import SimpleNamespace

import by_definition as codec
import pytest

pytest.importorskip('rospy')
from campaign import storm  # noqa: E402
from campaign.boards import COUNTER, MEMORY, car_keys, reply_keys  # noqa: E402
from campaign.requirements import Table  # noqa: E402
from campaign.robot import NOT_SENT, TIMEOUT, Outcome, Published  # noqa: E402

HEARTBEAT = codec.arduino_packet(codec.HEARTBEAT)
TOKEN = struct.pack('<I', 7)


def speed(value):
    return codec.arduino_packet(codec.SPEED, struct.pack('<h', value))


class FakeStorm:
    """Has what the checks use of a Storm."""

    def __init__(self):
        self.table = Table()
        self.histories = {'arduino': storm.LineHistory(codec.arduino_at, car_keys),
                          'bus': storm.LineHistory(codec.reply_at, reply_keys)}
        self.rig = SimpleNamespace(
            require=self.table.require, has_priority=lambda: True, was_starved=lambda *_: False,
            car_line=SimpleNamespace(plugged=True),
            robot=SimpleNamespace(command=lambda name, value, stamp: None))
        self.violated = []
        self.from_damage = self.table.require('storm', 'from damage', True)

    def record(self, *what):
        pass

    def check(self, required, holds, text):
        if not required.check(holds, text):
            self.violated.append(required.text)
        return holds


@pytest.fixture
def fake():
    return FakeStorm()


@pytest.fixture
def motor(fake):
    check = storm.MotorCheck(fake)
    check.start_connection()
    return check


def heartbeats(check, number, start=100.0, period=0.01):
    for index in range(number):
        check.read(HEARTBEAT, start + index * period)


def test_stop_in_time(fake, motor):
    motor.command(300)
    motor.read(speed(0) + HEARTBEAT + speed(300), 100.0)
    heartbeats(motor, 55)
    motor.read(speed(0), 101.0)
    heartbeats(motor, 30, 100.55)
    assert fake.violated == []


def test_no_stop(fake, motor):
    motor.command(300)
    motor.read(speed(0) + speed(300), 100.0)
    heartbeats(motor, 58)
    assert set(fake.violated) == {'SPEED 0 within speed_timeout + 50 ms, in heartbeats'}


@pytest.mark.parametrize('first', [HEARTBEAT, speed(300)])
def test_first_packet_of_a_connection_is_not_speed_0(fake, motor, first):
    motor.command(300)
    motor.read(first, 100.0)
    assert 'SPEED 0 is the first packet whenever the port opens' in fake.violated


def test_speed_sent_twice_and_speed_not_commanded(fake, motor):
    motor.command(300)
    motor.read(speed(0) + speed(300), time.monotonic())
    assert fake.violated == []
    motor.read(speed(300) + speed(301), time.monotonic())
    assert fake.violated == ['every SPEED was commanded, and is sent once'] * 2


def test_speed_from_before_a_reconnect(fake, motor):
    motor.command(300)
    motor.start_connection()
    motor.read(speed(0) + speed(300), time.monotonic() + 2.0)
    assert fake.violated == ['no SPEED from before a reconnect']


def test_heartbeat_gap(fake, motor):
    motor.read(speed(0), 99.0)
    heartbeats(motor, 100)
    motor.read(HEARTBEAT * 60, 101.6)       # read late, and not yet all of them
    heartbeats(motor, 300, 101.6)
    assert fake.violated == []
    heartbeats(motor, 300, 104.65)          # all were read late, so none may have been sent late
    assert fake.violated == []
    heartbeats(motor, 200, 107.65)
    assert fake.violated == ['no gap of 30 ms between heartbeats of an open port']


def test_heartbeat_gap_is_not_decided_if_the_machine_gave_no_time(fake, motor):
    fake.rig.was_starved = lambda gap, since: since < 101.1 and gap > 0.03
    motor.read(speed(0), 99.0)
    heartbeats(motor, 100)
    heartbeats(motor, 500, 101.05)
    required = fake.table.require('storm: motor',
                                  'no gap of 30 ms between heartbeats of an open port')
    assert fake.violated == [] and required.undecided == 1


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
    calls._check(key, outcome, time.time())
    assert bool(fake.violated) == bool(violated)
    assert all(violated in text for text in fake.violated)


def test_wrong_outcome_from_a_frame_that_damage_created(fake):
    calls = storm.CallCheck(fake)
    began = time.time() - 1
    created = b'\xa5\x20' + codec.bus_frame(b'\3', b'\2\x80')
    fake.histories['bus'].add(b'x', created, began + 0.5)
    for violated in [], ['outcome refused or not sent: not executed']:
        calls.executed[MEMORY, TOKEN] = 1
        calls._check((MEMORY, TOKEN), Outcome(False, 3, 0.1, ''), began)
        assert fake.violated == violated
        error = codec.bus_frame(b'\3', b'\2\x80')      # which the board sent for another call
        fake.histories['bus'].add(error, error, began + 0.5)


def test_wrong_outcome_of_a_request_that_damage_changed_to_another(fake):
    calls, key, began = storm.CallCheck(fake), (MEMORY, TOKEN), time.time()
    calls._unchecked.add(key)
    calls.received(key)
    both = ['outcome done: executed exactly once', 'a raw call returns the data of its own reply']
    for violated in both, []:
        calls._check(key, Outcome(True, 2, 60.0, '', b'else'), began)
        assert fake.violated == violated
        fake.violated.clear()
        calls.received((MEMORY, b'else'))


def test_published_values(fake):
    fake.histories['mcu'] = fake.histories['arduino']
    values = storm.ValueCheck(fake)
    frame = codec.arduino_packet(COUNTER, struct.pack('<I', 5))
    now = time.time()
    fake.histories['arduino'].add(frame, frame, now)
    values.check('~counter', Published(now, 0.0, 5, None))
    assert fake.violated == []
    values.check('~counter', Published(now, 0.0, 6, None))
    assert fake.violated == ['every published value was in a valid frame']
    created = codec.arduino_packet(COUNTER, struct.pack('<I', 6))
    fake.histories['arduino'].add(frame, b'\x09' + created, now)
    values.check('~counter', Published(now, 0.0, 6, None))
    assert len(fake.violated) == 1


def test_what_was_checked_is_forgotten(fake):
    history, calls = fake.histories['arduino'], storm.CallCheck(fake)
    motor, sizes = storm.MotorCheck(fake), []
    for step in range(3600):
        now = step / 10
        frame = codec.arduino_packet(COUNTER, struct.pack('<I', step))
        history.add(frame, frame, now)
        motor.command(step % 999 + 1)
        motor.read(speed(step % 999 + 1), now)
        heartbeats(motor, 10, now)
        key = MEMORY, struct.pack('<I', step)
        calls.executed[key] = 1
        calls._check(key, Outcome(True, 2, 0.1, '', key[1]), now)
        sizes.append([len(kept) for kept in (
            history._writes, history._sent, calls.executed, motor._commands, motor._times)])
    assert fake.violated == []
    assert [max(kept) for kept in zip(*sizes)] == [max(kept) for kept in zip(*sizes[:600])]
