"""The simulated model car."""
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation_bench import Bench

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.simulator import ModelCar

HEARTBEAT = arduino.encode(arduino.Heartbeat())


def make(**arguments):
    return Bench(ModelCar(**arguments), arduino.Decoder())


def drive(bench, seconds, speed=None, steering=None):
    """Send heartbeats for `seconds`, and the commands at the begin."""
    bench.feed(HEARTBEAT)
    for command in (arduino.SpeedCommand(speed) if speed is not None else None,
                    arduino.SteeringCommand(steering) if steering is not None else None):
        if command is not None:
            bench.feed(arduino.encode(command))
    for _ in range(round(seconds * 100)):
        bench.feed(HEARTBEAT)
        bench.run(0.01)


def motor(bench):
    return [(fields['on'], fields['why']) for fields in bench.notes('motor')]


def counts(messages):
    return {kind: sum(isinstance(message, kind) for message in messages)
            for kind in (arduino.Ticks, arduino.SteeringAngle, arduino.Imu, arduino.Voltage)}


def test_rates():
    bench = make()
    bench.run(30.0001)
    assert counts(bench.messages()) == {arduino.Ticks: 3000, arduino.SteeringAngle: 3000,
                                        arduino.Imu: 3000, arduino.Voltage: 30}


def test_motor_stops_30_ms_after_the_last_heartbeat_until_a_new_command():
    bench = make()
    drive(bench, 1, speed=500)
    assert bench.board.motor_on and bench.board.velocity > 1
    bench.feed(HEARTBEAT)
    last = bench.now
    assert bench.run(1, until=lambda: not bench.board.motor_on)
    assert bench.now == pytest.approx(last + 0.03)
    assert motor(bench)[-1] == (False, 'no heartbeat for 30 ms')
    drive(bench, 3)
    assert not bench.board.motor_on and bench.board.velocity == 0
    drive(bench, 0.2, speed=-500)
    assert bench.board.motor_on and bench.board.command == -500


def test_speed_follows_with_a_lag_and_saturates():
    bench = make()
    drive(bench, 0.25, speed=2000)
    assert bench.board.command == 1000
    assert 0.5 < bench.board.velocity / 2.5 < 0.75
    drive(bench, 2)
    assert bench.board.velocity == pytest.approx(2.5, rel=0.01)
    drive(bench, 3, speed=0)
    assert bench.board.velocity == 0


def test_imu_follows_the_motion_which_a_longer_pulse_turns_to_the_right():
    bench = make()
    drive(bench, 1)
    still = bench.messages(arduino.Imu)[-1]
    assert still.linear_acceleration() == pytest.approx((0, 0, 9.81), abs=0.3)
    drive(bench, 0.2, speed=800, steering=1800)
    assert bench.messages(arduino.Imu)[-1].linear_acceleration()[0] > 1     # it speeds up
    drive(bench, 3, speed=800, steering=1800)
    turning = bench.messages(arduino.Imu)
    rate = sum(message.angular_velocity()[2] for message in turning[-100:]) / 100
    assert rate == pytest.approx(-2.0 * math.tan(math.radians(25) * 0.6) / 0.26, rel=0.05)
    assert turning[-1].linear_acceleration()[1] == pytest.approx(2.0 * rate, rel=0.1)
    assert all(not message.implausible() for message in turning)

    def yaw(message):
        x, y, z, w = message.orientation()
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    turned = (yaw(turning[-1]) - yaw(turning[-101])) % (2 * math.pi)
    assert turned == pytest.approx(rate % (2 * math.pi), abs=0.1)


def test_bytes_received_during_a_calibration_are_read_after_it():
    bench = make(calibration_time=20)
    drive(bench, 0.5, speed=200)
    bench.feed(arduino.encode(arduino.ImuCalibration()))
    assert not bench.board.motor_on
    bench.messages()
    led = arduino.encode(arduino.LedCommand('brake'))
    speed = arduino.encode(arduino.SpeedCommand(400))
    bench.feed(led + HEARTBEAT + speed)
    drive(bench, 19.9)
    assert bench.board.led == 'disable'
    seen = counts(bench.messages())
    assert seen[arduino.Imu] == 0 and seen[arduino.Ticks] == 1990
    bench.run(0.2)
    assert counts(bench.messages())[arduino.Imu] > 5
    assert bench.board.led == 'brake'
    assert (True, 'SPEED 400') in motor(bench)      # the bridge has to avoid this


@given(st.lists(st.tuples(st.binary(max_size=80), st.floats(0, 0.1))))
def test_works_after_any_input(chunks):
    bench = make(calibration_time=0.2)
    for data, pause in chunks:
        bench.feed(data)
        bench.run(pause)
    bench.run(0.5)
    drive(bench, 0.1, speed=100)
    assert bench.board.motor_on and bench.messages(arduino.Imu)
