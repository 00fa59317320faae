"""What the link to the model car says and refuses; the judge decides what reaches the motor, and
when (test/sim)."""
import re

import pytest

from steps import MemoryPort, Steps
from board_rows import car_settings as arduino_settings
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.boards.arduino.wire import (ImuCalibration, LedCommand, SpeedCommand,
                                                      SteeringCommand)
from serial_communication.framing.layout import Value, message_class
from serial_communication.framing.settings import message_of
from serial_communication.link.link import OK, WARN, Refused

STEADY = ArduinoSettings(speed_timeout=0.0)       # no speed times out
STOP = arduino.encode(SpeedCommand(0))
BEAT = arduino.encode(arduino.Heartbeat())
GRIPPER = message_class('gripper', 48, '<hB', [Value('x', scale=0.1, maximum=100), Value('z')])
TEXT = message_class('text', 49, '<s', [Value('data')])
IMU = arduino.encode(arduino.Imu(16384, *[0] * 10))


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


@pytest.mark.parametrize('asked, value', [(1000, 1000), (-1000, -1000), (1001, 1000),
                                          (-10 ** 9, -1000)])
def test_a_speed_is_saturated_with_a_warning(car, lines, asked, value):
    car.link.set_speed(asked)
    assert sent(car, SpeedCommand(value)) and bool(lines(str(asked))) == (asked != value)


@pytest.mark.parametrize('text', ['x' * 31, 'blinké', 'a\0', 'x' * 1000000])
def test_an_invalid_led_text_is_refused_with_a_short_text(car, text):
    refused = str(refusal(car.link.set_led, text))
    assert 'refused' in refused and len(refused) < 100
    car.link.set_led('x' * 30)
    assert sent(car, LedCommand('x' * 30))


def test_what_cannot_be_sent_is_refused_with_a_short_text(car):
    for message, said in (
            (GRIPPER(100.1, 9), 'gripper refused: x is 100.1, above the maxi'),
            (GRIPPER(1.0, 256), 'gripper refused: z is 256, which its place'),
            (message_class('dial', 50, '<B', [Value('text', maximum=5)])(9),
             'dial refused: text is 9, above'),
            (TEXT('x' * 256), 'text refused: 256 bytes of data, a packet holds at most 255'),
            (TEXT('x' * 10 ** 6), 'text refused: 1000000 bytes of data, a packet holds at most')):
        assert str(refusal(car.link.command, message)).startswith(said)
    car.link.command(TEXT('x' * 255))
    assert sent(car, TEXT('x' * 255))


def test_while_the_board_calibrates_or_the_port_is_closed_every_command_is_refused(logger, lines):
    changes = []
    car = start(logger, on_calibrating=changes.append)
    link = car.link
    commands = (lambda: link.set_speed(500), lambda: link.set_speed(0),
                lambda: link.set_steering(1), lambda: link.set_led('left'), link.calibrate_imu)
    link.calibrate_imu()
    assert {refusal(command).cause for command in commands} == {'calibrating'}
    assert str(refusal(link.command, GRIPPER(1.0, 2))).startswith(
        'gripper x=1 z=2 refused: the board calibrates its IMU')
    assert link.condition(car.port.time) == (WARN, 'calibrating the IMU')
    assert dict(link.report(car.port.time).values)['condition'] == 'calibrating'
    car.run(3.0).give(IMU, 1.0)
    assert changes == [True, False] and sent(car, ImuCalibration())
    car.unplug()
    assert all('closed' in str(refusal(command)) for command in commands)


def test_a_calibration_ends_after_its_timeout(logger, lines):
    car = start(logger, STEADY._replace(calibration_timeout=5.0))
    car.link.calibrate_imu()
    assert car.run(6.0) and not car.link.calibrating
    assert lines('the calibration did not end within 5 s')


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
    assert car.link.decoder.errors['implausible'] == check


def test_a_setting_that_is_no_number_is_not_used_also_without_check_plausibility(logger):
    rows = arduino_settings({'kp': {'setting': 1, 'layout': '<f'}})
    car = start(logger, STEADY._replace(check_plausibility=False))
    for row in rows:
        car.link.board_settings.add(row)
    kind = message_of(rows)
    car.give(arduino.encode(kind(1, 1.5)) + arduino.encode(kind(1, float('nan'))))
    assert car.link.board_settings.shown()['kp'][0] == 1.5
    assert car.link.decoder.errors['implausible'] == 1


def test_log_messages_are_passed_on_at_a_limited_rate(logger, lines):
    said = []
    car = start(logger, on_log=lambda severity, text: said.append((severity, text)))
    car.give(arduino.encode(arduino.Log(2, 'hot')))
    assert said == [(2, 'hot')]
    car.give(arduino.encode(arduino.Log(0, 'again')) * 500)
    assert 50 <= len(said) <= 200 and len(lines('logs too much')) == 1


@pytest.mark.parametrize('rate', [100.0, 20.0])
def test_heartbeats_are_sent_at_their_rate(logger, rate):
    car = start(logger, STEADY._replace(heartbeat_rate=rate)).run(10.0)
    assert car.port.wrote.count(BEAT) == pytest.approx(10 * rate, abs=1)


def test_speed_0_is_sent_if_no_speed_command_follows(logger, lines):
    car = start(logger, STEADY._replace(speed_timeout=0.1))
    car.link.set_speed(300)
    car.run(2.0)
    assert len(lines('sent SPEED 0')) == 1 and car.port.wrote.count(STOP) == 21


def test_a_heartbeat_gap_is_a_warning_until_a_report_without_a_gap(car):
    ticks = arduino.encode(arduino.Ticks(1))
    car.give(ticks).link.report(car.port.time)
    car.port.time += 0.1        # no thread runs
    car.run(0.05)
    level, summary, values = car.link.report(car.port.time)
    assert level == WARN and re.match(
        'heartbeat gap of [0-9.]+ ms: after 30 ms the board stops its motor; see "Let the bridge '
        'come first" in doc/troubleshooting.md$', summary)
    assert dict(values)['heartbeat gap [ms]'] == dict(values)['heartbeat max gap [ms]']
    car.give(ticks, 0.1)
    assert car.link.report(car.port.time)[:2] == (OK, 'open')


def test_after_a_stall_speed_0_is_first_and_commands_are_refused_for_0_5_s(car, lines):
    car.link.set_speed(300)
    car.port.wrote.clear()
    car.port.time += 2.0        # no thread runs
    assert str(refusal(car.link.set_speed, 400)) == (
        'speed 400 refused: it may have waited while the bridge stalled; send it again')
    car.run(0.4)
    assert car.port.wrote[0] == STOP and refusal(car.link.set_led, 'left').cause == 'stall'
    assert lines(' s: SPEED 0 is sent first') and not refusal(car.run(0.2).link.set_speed, 400)


# -- ports that hide what they have not sent -------------------------------------------------------

def behind(logger, kind):
    """A car behind such a port, which talks at first."""
    return start(logger, STEADY._replace(network_silence=1.5), port=MemoryPort(kind)).give(
        arduino.encode(arduino.Ticks(1)))


def test_commands_to_a_pty_whose_board_is_silent_are_refused_until_it_talks(logger, lines):
    car = behind(logger, 'pty')
    car.run(1.4).link.set_speed(300)
    car.port.wrote.clear()
    car.run(0.2)
    assert b'\0' + STOP in car.port.wrote
    assert lines('nothing received from the board for 1.5 s: what was written is dropped')
    assert refusal(car.link.set_speed, 300) and refusal(car.run(60.0).link.set_led, 'left')
    assert car.link.connection.number == 1
    assert not refusal(car.give(arduino.encode(arduino.Ticks(1)), 0.2).link.set_speed, 300)


def test_a_board_behind_a_pty_that_never_talks_or_calibrates_may_be_silent(logger):
    car = start(logger, port=MemoryPort('pty'))
    assert not refusal(car.run(60.0).link.set_speed, 300)
    car = behind(logger, 'pty')
    car.link.calibrate_imu()
    assert refusal(car.run(60.0).link.set_speed, 300).cause == 'calibrating'


def test_a_silent_network_port_is_opened_anew_behind_speed_0_but_not_in_a_calibration(
        logger, lines):
    car = behind(logger, 'network')
    before = car.link.connection.number
    car.link.set_speed(300)
    car.port.wrote.clear()
    car.run(1.6)
    assert lines('nothing received from the board for 1.5 s')
    assert car.port.wrote.count(STOP) >= 2 and car.link.connection.number == before + 1
    car.link.calibrate_imu()
    assert car.run(60.0).link.connection.number == before + 1
