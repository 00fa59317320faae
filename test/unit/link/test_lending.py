"""What a loan answers, and when it ends; what is sent before it, the judge decides (test/sim)."""
import pytest
from links import McuLink

from serial_communication.link.session import WARN, Refused
from serial_communication.transport.port import Port


@pytest.fixture
def clock():
    return [100.0]


@pytest.fixture
def link(clock):
    return McuLink(Port('/dev/none'), now=lambda: clock[0])


def test_one_program_at_a_time_has_a_loan_and_ends_it(link):
    lending = link.lending
    assert lending.lend('avrdude', 10.0) == 'lent to avrdude'
    report = link.report(100.0)
    assert report[:2] == (WARN, 'lent to avrdude') and dict(report.values)['condition'] == 'lent'
    with pytest.raises(Refused, match='the port is lent to avrdude'):
        lending.lend('minicom', 5.0)
    lending.lend('avrdude', 0.0)
    assert not lending.runs


@pytest.mark.parametrize('asked', [10.0, 60.0, float('inf')])
def test_a_loan_ends_by_itself_after_10_s(link, clock, asked):
    link.lending.lend('x', asked)
    clock[0] += 9.99
    assert link.lending.runs
    clock[0] += 0.02
    assert not link.lending.runs


@pytest.mark.parametrize('by, seconds', [('', 5.0), (' ', 5.0), ('x', -1.0), ('x', float('nan'))])
def test_a_wrong_loan_is_refused(link, by, seconds):
    with pytest.raises(Refused) as refused:
        link.lending.lend(by, seconds)
    assert refused.value.cause == 'value' and not link.lending.runs


@pytest.mark.parametrize('line, cause', [('', 'value'), ('dtr', 'port')])
def test_a_board_without_such_a_line_or_behind_a_closed_port_is_not_reset(link, line, cause):
    link.lending.reset_line = line
    with pytest.raises(Refused) as refused:
        link.lending.reset()
    assert refused.value.cause == cause
