"""The judges of the statistical part: what they call a violation, and what not."""
import struct
import time
from types import SimpleNamespace

import by_definition as codec
import pytest

pytest.importorskip('rospy')
from campaign import storm  # noqa: E402
from campaign.boards import COUNTER, MEMORY, car_keys, reply_keys  # noqa: E402
from campaign.robot import NOT_SENT, TIMEOUT, Got, Told  # noqa: E402
from campaign.rows import Table  # noqa: E402

HEARTBEAT = codec.arduino_packet(codec.HEARTBEAT)
TOKEN = struct.pack('<I', 7)


def speed(value):
    return codec.arduino_packet(codec.SPEED, struct.pack('<h', value))


class Stand:
    """In the place of a Storm."""

    def __init__(self):
        self.table = Table()
        self.wires = {'arduino': storm.Wire(codec.arduino_at, car_keys),
                      'bus': storm.Wire(codec.reply_at, reply_keys)}
        self.field = SimpleNamespace(
            row=self.table.row, has_priority=lambda: True, was_starved=lambda *_: False,
            car_line=SimpleNamespace(plugged=True),
            robot=SimpleNamespace(command=lambda name, value, stamp: None))
        self.broken = []
        self.blind = self.table.row('storm', 'blind', True)

    def record(self, *what):
        pass

    def check(self, row, holds, text):
        if not row.check(holds, text):
            self.broken.append(row.promise)
        return holds


@pytest.fixture
def stand():
    return Stand()


@pytest.fixture
def motor(stand):
    judge = storm.MotorJudge(stand)
    judge.open_anew()
    return judge


def beats(judge, number, start=100.0, period=0.01):
    for index in range(number):
        judge.read(HEARTBEAT, start + index * period)


def test_a_stop_in_time(stand, motor):
    motor.command(300)
    motor.read(speed(0) + HEARTBEAT + speed(300), 100.0)
    beats(motor, 55)
    motor.read(speed(0), 101.0)
    beats(motor, 30, 100.55)
    assert stand.broken == []


def test_no_stop(stand, motor):
    motor.command(300)
    motor.read(speed(0) + speed(300), 100.0)
    beats(motor, 58)
    assert set(stand.broken) == {'SPEED 0 within speed_timeout + 50 ms, by heartbeats'}


@pytest.mark.parametrize('first', [HEARTBEAT, speed(300)])
def test_first_packet_of_a_connection(stand, motor, first):
    motor.command(300)
    motor.read(first, 100.0)
    assert 'at every opening SPEED 0 goes out before any heartbeat' in stand.broken


def test_a_speed_twice_and_one_of_nobody(stand, motor):
    motor.command(300)
    motor.read(speed(0) + speed(300), time.monotonic())
    assert stand.broken == []
    motor.read(speed(300) + speed(301), time.monotonic())
    assert stand.broken == ['no speed that was not commanded, none twice'] * 2


def test_a_speed_of_before_a_reconnect(stand, motor):
    motor.command(300)
    motor.open_anew()
    motor.read(speed(0) + speed(300), time.monotonic() + 2.0)
    assert stand.broken == ['no speed of before a reconnect']


def test_heartbeats(stand, motor):
    motor.read(speed(0), 99.0)
    beats(motor, 100)
    motor.read(HEARTBEAT * 60, 101.6)       # read late, and not yet all of them
    beats(motor, 300, 101.6)
    assert stand.broken == []
    beats(motor, 300, 104.65)               # however late they were read, they were not sent later
    assert stand.broken == []
    beats(motor, 200, 107.65)
    assert stand.broken == ['no gap of 30 ms between heartbeats while the port is open']


def test_a_gap_in_which_the_machine_stood_still_is_not_decided(stand, motor):
    stand.field.was_starved = lambda gap, since: since < 101.1 and gap > 0.03
    motor.read(speed(0), 99.0)
    beats(motor, 100)
    beats(motor, 500, 101.05)
    row = stand.table.row('storm: motor',
                          'no gap of 30 ms between heartbeats while the port is open')
    assert stand.broken == [] and row.undecided == 1


@pytest.mark.parametrize('told, executed, broken', [
    (Told(True, 2, 0.1, '', TOKEN), 1, ''), (Told(True, 2, 0.1, '', TOKEN), 0, 'success'),
    (Told(True, 2, 0.1, '', TOKEN), 2, 'success'), (Told(False, 3, 0.1, ''), 0, ''),
    (Told(False, 3, 0.1, ''), 1, 'refused'), (Told(False, NOT_SENT, 0.1, ''), 1, 'refused'),
    (Told(False, TIMEOUT, 0.1, ''), 1, ''), (Told(False, TIMEOUT, 0.1, ''), 2, 'timeout'),
    (Told(True, 2, 0.1, '', b'else'), 1, 'own data')])
def test_what_a_caller_is_told(stand, told, executed, broken):
    judge = storm.CallJudge(stand)
    key = MEMORY, TOKEN
    judge.executed[key] = executed
    judge._judge(key, told, time.time())
    assert bool(stand.broken) == bool(broken) and all(broken in text for text in stand.broken)


def test_a_caller_told_wrong_by_a_frame_that_damage_made(stand):
    judge = storm.CallJudge(stand)
    began = time.time() - 1
    stand.wires['bus'].carried(b'x', b'\xa5\x20' + codec.bus_frame(b'\3', b'\2\x80'), began + 0.5)
    for broken in [], ['told refused or not sent: not executed']:
        judge.executed[MEMORY, TOKEN] = 1
        judge._judge((MEMORY, TOKEN), Told(False, 3, 0.1, ''), began)
        assert stand.broken == broken
        error = codec.bus_frame(b'\3', b'\2\x80')      # which the board has sent to another
        stand.wires['bus'].carried(error, error, began + 0.5)


def test_published_values(stand):
    stand.wires['mcu'] = stand.wires['arduino']
    judge = storm.PublishedJudge(stand)
    frame = codec.arduino_packet(COUNTER, struct.pack('<I', 5))
    now = time.time()
    stand.wires['arduino'].carried(frame, frame, now)
    judge.take('~counter', Got(now, 0.0, 5, None))
    assert stand.broken == []
    judge.take('~counter', Got(now, 0.0, 6, None))
    assert stand.broken == ['no value that no valid frame on the line had']
    made = codec.arduino_packet(COUNTER, struct.pack('<I', 6))
    stand.wires['arduino'].carried(frame, b'\x09' + made, now)
    judge.take('~counter', Got(now, 0.0, 6, None))
    assert len(stand.broken) == 1
