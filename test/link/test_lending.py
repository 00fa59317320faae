"""What borrowing a port and resetting a board answer; the judge decides what is sent (test/sim)."""
import pytest

from steps import Steps
from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.boards.bus import wire
from serial_communication.boards.bus.link import BusLink
from serial_communication.boards.mcu.link import McuLink
from serial_communication.link import lending
from serial_communication.link.link import WARN, Refused
from serial_communication.link.outcome import NOT_SENT


@pytest.fixture
def sensors():
    return Steps(McuLink).run(0.1)


def refused(why):
    return False, f'status 253 (not sent): {why}'


def lend(steps, by='avrdude', seconds=10.0):
    task = steps.link.lending.ask_for_loan(by, seconds)
    steps.run(0.0)
    return task.answer


def reset(steps, line='dtr'):
    steps.link.lending.line = line
    task = steps.link.lending.ask_for_reset()
    steps.run(0.0)
    return task.answer


def test_a_lent_port_is_closed_until_it_is_given_back(sensors):
    assert lend(sensors) == (True, 'lent to avrdude')
    link = sensors.link
    assert not link.port.is_open and link.condition(0.0) == (WARN, 'lent to avrdude')
    assert dict(link.report(0.0).values)['condition'] == 'lent'
    assert lend(sensors, 'minicom', 5.0) == refused('the port is lent to avrdude')
    assert lend(sensors, seconds=0.0) == (True, 'the port is opened again')
    assert sensors.run(2.0).port.is_open


@pytest.mark.parametrize('asked', [60.0, float('inf')])
def test_a_loan_ends_by_itself_after_10_s(sensors, asked):
    assert lend(sensors, seconds=asked)[0]
    assert not sensors.run(9.9).port.is_open
    assert sensors.run(1.5).port.is_open


@pytest.mark.parametrize('by, seconds', [('', 5.0), (' ', 5.0), ('x', -1.0), ('x', float('nan'))])
def test_a_wrong_loan_is_refused(sensors, by, seconds):
    done, text = lend(sensors, by, seconds)
    assert not done and 'are needed' in text and sensors.port.is_open


def test_a_name_is_one_short_line(sensors):
    assert lend(sensors, 'a\nb' + 'c' * 500, 5.0)[0]
    assert sensors.link.condition(0.0)[1] == 'lent to a\ufffdb' + 'c' * 57


def test_after_the_loan_the_port_waits_for_a_program_that_still_has_it_open(sensors, monkeypatch):
    lend(sensors, seconds=1.0)
    monkeypatch.setattr(sensors.port, '_others_have', lambda path: True)
    assert sensors.run(3.0).link.condition(0.0)[1] == (
        'closed: it was lent to avrdude, and another program still has it open')


def test_a_task_that_the_links_thread_does_not_begin_is_not_known_and_not_done(
        sensors, monkeypatch):
    monkeypatch.setattr(lending, '_PATIENCE', 0.0)
    done, text = sensors.link.lending.lend('me', 5.0)
    assert not done and text.startswith('status 254 (not known): the link did not confirm')
    assert sensors.run(1.0).link.connection.number == 1


def test_a_call_from_before_a_stall_lends_and_resets_nothing(sensors, monkeypatch):
    monkeypatch.setattr(sensors.link.lending, '_may_be_old', lambda: True)
    assert lend(sensors) == reset(sensors) == refused(lending.STALLED)


def test_a_car_that_calibrates_is_not_lent_and_a_lent_one_takes_no_command():
    car = Steps(ArduinoLink).run(0.1)
    car.link.calibrate_imu()
    assert lend(car) == refused('not now: the board calibrates its IMU, which takes minutes')
    car.link.output.calibration = None
    assert lend(car)[0]
    with pytest.raises(Refused, match='lent to avrdude'):
        car.link.set_speed(300)


def test_calls_on_a_lent_bus_are_not_sent():
    bus = Steps(BusLink).run(0.1)
    assert lend(bus)[0]
    outcome = bus.link.request(wire.lift(0, 100))
    assert outcome.status == NOT_SENT and 'lent to avrdude' in outcome.message


def test_a_reset_is_a_pulse_and_a_new_opening(sensors):
    assert reset(sensors, 'rts') == (True, 'reset by RTS')
    assert sensors.port.pulses == ['rts'] and sensors.run(2.0).link.connection.number == 2


def test_a_board_without_such_a_line_is_not_reset(sensors):
    assert reset(sensors, '') == refused(
        'no line that resets this board is known (parameter reset_line)')
    sensors.port.is_pty = True
    assert reset(sensors) == refused('the port /dev/none has no control lines')
    sensors.port.is_pty = False
    sensors.unplug()
    assert reset(sensors) == refused('the port is closed')
