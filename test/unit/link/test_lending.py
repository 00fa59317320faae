"""What borrowing a port and resetting a board answer; the judge decides what is sent (test/sim)."""
import pytest

from steps import Steps
from links import McuLink
from serial_communication.link.session import WARN, Refused


@pytest.fixture
def sensors():
    return Steps(McuLink).run(0.1)


def refused(why):
    return False, why


def lend(steps, by='avrdude', seconds=10.0):
    return answer(steps, lambda: steps.link.lending.lend(by, seconds))


def reset(steps, line='dtr'):
    steps.link.lending.reset_line = line
    return answer(steps, steps.link.lending.reset)


def answer(steps, ask):
    """Whether it was done, and what is said."""
    try:
        return True, ask()
    except Refused as refused:
        return False, str(refused)
    finally:
        steps.run(0.0)


def test_a_lent_port_is_closed_until_it_is_given_back(sensors):
    assert lend(sensors) == (True, 'lent to avrdude')
    link = sensors.link
    assert not link.port.is_open and link.report(0.0)[:2] == (WARN, 'lent to avrdude')
    assert dict(link.report(0.0).values)['condition'] == 'lent'
    assert lend(sensors, 'minicom', 5.0) == refused('the port is lent to avrdude')
    assert lend(sensors, seconds=0.0) == (True, 'the port is opened again')
    assert sensors.run(2.0).port.is_open


def test_a_port_that_is_lent_while_it_is_opened_is_closed_again(sensors):
    sensors.unplug()
    opened = sensors.port._open
    sensors.port._open = lambda: (sensors.link.lending.lend('x', 5.0), opened())[1]
    assert not sensors.plug().port.is_open
    sensors.port._open = opened
    assert sensors.run(6.0).port.is_open


@pytest.mark.parametrize('asked', [60.0, float('inf')])
def test_a_loan_ends_by_itself_after_10_s(sensors, asked):
    assert lend(sensors, seconds=asked)[0]
    assert not sensors.run(9.9).port.is_open
    assert sensors.run(1.5).port.is_open


@pytest.mark.parametrize('by, seconds', [('', 5.0), (' ', 5.0), ('x', -1.0), ('x', float('nan'))])
def test_a_wrong_loan_is_refused(sensors, by, seconds):
    done, text = lend(sensors, by, seconds)
    assert not done and 'are needed' in text and sensors.port.is_open


def test_a_reset_is_a_pulse_and_the_port_stays_open(sensors):
    assert reset(sensors, 'rts') == (True, 'reset by RTS')
    assert sensors.port.pulses == ['rts'] and sensors.run(2.0).link.reopening.count == 1


def test_a_board_without_such_a_line_is_not_reset(sensors):
    no_line = refused(
        'the port /dev/none has no line that resets its board (parameter reset_line)')
    assert reset(sensors, '') == no_line
    sensors.port._opened.is_pty = True
    assert reset(sensors) == no_line
    sensors.port._opened.is_pty = False
    sensors.unplug()
    assert reset(sensors) == refused('the port is closed')
