"""What the link to the model car says and refuses; the judge decides what reaches the motor, and
when (test/sim)."""

import pytest

from steps import Steps
from serial_communication.boards.arduino import wire as arduino
from links import ArduinoLink
from serial_communication.boards.arduino.session import CarOptions
from serial_communication.boards.arduino.wire import LedCommand, SpeedCommand, SteeringCommand
from serial_communication.framing.layout import Value, message_class
from serial_communication.link.session import Refused

STEADY = CarOptions(speed_timeout=0.0)       # no speed times out
STOP = arduino.encode(SpeedCommand(0))
BEAT = arduino.encode(arduino.Heartbeat())
GRIPPER = message_class('gripper', 48, '<hB', [Value('x', scale=0.1, maximum=100), Value('z')])


@pytest.fixture
def car(logger):
    return start(logger)


def start(logger, settings=STEADY, **options):
    made = Steps(ArduinoLink, settings, logger=logger, **options).run(2.0)
    made.port.wrote.clear()
    return made


def refusal(command, *arguments):
    """What the command raises if it is refused; None if it is sent."""
    try:
        command(*arguments)
    except Refused as refused:
        return refused
    return None


def sent(car, *messages):
    """Whether these messages were sent, without heartbeats and repetitions of SPEED 0."""
    wrote = [each for each in car.port.wrote if each.lstrip(b'\0') not in (STOP, BEAT)]
    return wrote == [arduino.encode(message) for message in messages]


def test_commands_are_sent_in_order(car):
    link = car.link
    link.set_speed(500), link.set_steering(1), link.set_led('left'), link.command(GRIPPER(12.5, 9))
    assert sent(car, SpeedCommand(500), SteeringCommand(1), LedCommand('left'), GRIPPER(12.5, 9))


def test_a_busy_line_takes_the_zero_that_ends_a_motion(car):
    car.link.set_speed(500)
    while refusal(car.link.set_led, 'x' * 30) is None:
        pass
    assert refusal(car.link.set_speed, 1).cause == 'busy'
    assert refusal(car.link.set_speed, 0) is None


@pytest.mark.parametrize('text', ['x' * 31, 'blinké', 'a\0', 'x' * 1000000])
def test_an_invalid_led_text_is_refused_with_a_short_text(car, text):
    refused = str(refusal(car.link.set_led, text))
    assert refused.startswith('LED text') and len(refused) < 100
    car.link.set_led('x' * 30)
    assert sent(car, LedCommand('x' * 30))


def test_measurements_are_passed_on_with_their_stamps(logger):
    got = []
    car = start(logger, clock=lambda: 'stamp',
                on_message=lambda message, stamp: got.append((message, stamp)))
    messages = [arduino.Ticks(7), arduino.SteeringAngle(512), arduino.Voltage(14.5),
                arduino.Imu(16384, *[0] * 10)]
    car.give(b''.join(map(arduino.encode, messages)))
    assert got == [(message, 'stamp') for message in messages]


@pytest.mark.parametrize('check', [True, False])
def test_implausible_values_are_dropped_only_if_checked(logger, check):
    got = []
    car = start(logger, STEADY._replace(check_plausibility=check),
                on_message=lambda message, stamp: got.append(message))
    car.give(arduino.encode(arduino.SteeringAngle(2000)) + arduino.encode(arduino.Ticks(1)))
    assert (arduino.SteeringAngle(2000) in got) != check and arduino.Ticks(1) in got
    assert car.link.session.errors['implausible'] == check
