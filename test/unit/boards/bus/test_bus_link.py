"""What the bus link refuses and says; the judge decides on outcomes, and when requests are sent
(test/sim)."""
import pytest

from steps import Bus
from bus_moves import gimbal, lift
from serial_communication.link.session import ERROR, OK
from serial_communication.link.outcome import NOT_SENT, TIMEOUT
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.call import MasterOptions

LIFT = lift(0, 100)


def test_calls_have_outcomes_and_diagnostics(logger):
    steps = Bus(logger=logger).run(1.0)
    assert steps.requests[0] == bus.SYNC_REQUEST
    for request in LIFT, gimbal(3, 45), bus.Request(bus.FUNCTION, 0x30, b'\xa5\x5a'):
        assert steps.call(request).success
    reading = steps.call(bus.ENVIRONMENT_REQUEST, bus.ENVIRONMENT_FUNCTION)
    assert bus.Environment.unpack(reading.data) == pytest.approx(
        (350, 25.63, 48.12))
    values = dict(steps.link.report(steps.port.time).values)
    assert values['timeouts'] == 0 and float(values['round trip p50 [ms]']) >= 0
    assert steps.link.report(steps.port.time)[:2] == (OK, 'ready')


def test_a_function_is_polled(logger):
    readings = []
    steps = Bus(clock=lambda: 'stamp', logger=logger)
    steps.link.session.polls.add(bus.ENVIRONMENT_FUNCTION, 1.0, lambda outcome: readings.append(
        (bus.Environment.unpack(outcome.data), outcome.stamp)))
    steps.run(5.5)
    assert readings == [(pytest.approx((350, 25.63, 48.12)), 'stamp')] * 6


@pytest.mark.parametrize('request_, is_slow', [
    (LIFT, True), (gimbal(0, 1), True), (bus.Request(bus.FUNCTION, 0x30), False),
    (bus.Request(0x0C, bus.LIFT), False)], ids=str)
def test_only_lift_and_gimbal_have_the_motion_timeout(logger, request_, is_slow):
    """In a call of its own and in a raw request."""
    steps = Bus(MasterOptions(motion_timeout=2.5), logger=logger).run(1.0)
    steps.rule = lambda request: b'' if request == request_ else None
    outcome = steps.call(request_)
    assert outcome.status == TIMEOUT
    assert outcome.message.startswith('no reply within %g s:' % (2.5 if is_slow else 0.5))


def test_invalid_arguments_are_refused_without_sending(logger):
    for make, said in ((lift, 'lift: direction is 4'), (gimbal, 'angle is 256')):
        with pytest.raises(ValueError, match=said):
            make(*((4, 10) if make is lift else (0, 256)))
    outcome = Bus(logger=logger).run(1.0).link.request(bus.Request(1, 0, bytes(1025)))
    assert outcome.status == NOT_SENT and '1025' in outcome.message
    assert 'nothing was sent' in outcome.message


def test_a_closed_port_refuses_at_once(logger):
    steps = Bus(logger=logger)
    steps.port.is_there = False
    link = steps.run(1.0).link
    outcome = link.request(LIFT)
    assert outcome.status == NOT_SENT and 'closed' in outcome.message
    assert link.report(steps.port.time).level == ERROR
