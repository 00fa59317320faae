"""What the bus link refuses and says; the judge decides on outcomes, and when requests are sent
(test/sim)."""
import pytest

from steps import QUIET, Bus
from serial_communication.boards.bus.polls import Polls
from serial_communication.link.link import ERROR, OK, RX, TX
from serial_communication.boards.bus.session import Condition, Session
from serial_communication.link.outcome import NOT_SENT, TIMEOUT
from serial_communication.boards.bus import wire as bus

LIFT = bus.lift(0, 100)


def silent(*kinds):
    return lambda request: b'' if request.cmd1 in kinds else None


def test_calls_have_outcomes_and_diagnostics(logger):
    steps = Bus(logger=logger).run(1.0)
    assert steps.requests[0] == bus.SYNC_REQUEST
    for request in LIFT, bus.gimbal(3, 45), bus.Request(bus.FUNCTION, 0x30, b'\xa5\x5a'):
        assert steps.call(request).success
    reading = steps.call(bus.ENVIRONMENT_REQUEST, bus.ENVIRONMENT_FUNCTION)
    assert bus.Environment.unpack(reading.data) == (350, 25.63, 48.12)
    values = dict(steps.link.report(steps.port.time).values)
    assert values['timeouts'] == 0 and float(values['round trip p50 [ms]']) >= 0
    assert steps.link.report(steps.port.time)[:2] == (OK, 'ready')


def test_the_environment_is_polled_and_published(logger):
    readings = []
    Bus(QUIET._replace(environment_period=1.0), clock=lambda: 'stamp', logger=logger,
        on_environment=lambda reading, stamp: readings.append((reading, stamp))).run(5.5)
    assert readings == [((350, 25.63, 48.12), 'stamp')] * 6


def test_polls_skip_missed_periods_and_wait_for_the_outcome_of_the_one_before():
    class Asked:
        outcome = 'answered'

    asked, now = [], [0.0]
    polls = Polls(lambda request, function, on_success: asked.append(now[0]) or Asked())
    polls.add(bus.ENVIRONMENT_FUNCTION, 1.0, None)
    polls.start(10.0)
    for now[0] in (10.0, 10.5, 11.25, 11.75, 12.0, 17.5, 18.0, 18.5, 19.0, 19.5):
        polls.tick(now[0], True)
    assert asked == [10.0, 11.25, 12.0, 17.5, 18.5, 19.5]
    Asked.outcome = None
    for now[0] in (20.5, 21.5, 22.5):
        polls.tick(now[0], True)
    assert len(asked) == 6


@pytest.mark.parametrize('request_, is_slow', [
    (LIFT, True), (bus.gimbal(0, 1), True), (bus.Request(bus.FUNCTION, 0x30), False),
    (bus.Request(0x0C, bus.LIFT), False)], ids=str)
def test_only_lift_and_gimbal_have_the_motion_timeout(logger, request_, is_slow):
    """In a call of its own and in a raw request."""
    steps = Bus(QUIET._replace(motion_timeout=2.5), logger=logger).run(1.0)
    steps.rule = lambda request: b'' if request == request_ else None
    outcome = steps.call(request_)
    assert outcome.status == TIMEOUT
    assert outcome.message.startswith('no reply within %g s:' % (2.5 if is_slow else 0.5))


def test_a_damaged_reply_is_not_known_at_once(logger):
    steps = Bus(logger=logger).run(1.0)
    steps.rule = lambda request: b'\xa5\0\2\0' if request == LIFT else None
    outcome = steps.call(LIFT, seconds=1.0)
    assert outcome.status == TIMEOUT and 'damaged' in outcome.message and steps.moves == [LIFT]
    assert dict(steps.link.report(0).values)['checksum errors'] == 1


def test_invalid_arguments_are_refused_without_sending(logger):
    link = Bus(logger=logger).run(1.0).link
    for outcome, said in ((link.call(bus.LIFT_FUNCTION, (2, 10)), 'lift: direction is 2'),
                          (link.call(bus.GIMBAL_FUNCTION, (0, 256)), 'angle is 256'),
                          (link.request(bus.Request(1, 0, bytes(1025))), '1025')):
        assert outcome.status == NOT_SENT and said in outcome.message
        assert 'nothing was sent' in outcome.message


def test_a_closed_port_refuses_at_once(logger):
    steps = Bus(logger=logger)
    steps.port.is_there = False
    link = steps.run(1.0).link
    for outcome in (link.request(LIFT), link.environment()[0]):
        assert outcome.status == NOT_SENT and 'closed' in outcome.message
    assert link.report(steps.port.time).level == ERROR


def test_a_silent_board_is_an_error_and_a_line(logger, lines):
    steps = Bus(logger=logger)
    steps.rule = silent(bus.SYNC)
    assert steps.run(10.0).link.report(steps.port.time)[:2] == (
        ERROR, 'the board does not answer SYNC')
    assert len(lines('does not answer SYNC')) == 1 and steps.call(LIFT).status == NOT_SENT


def test_a_board_that_does_not_echo_is_an_error_that_names_the_parameter(logger, lines):
    steps = Bus(logger=logger)
    steps.rule = silent(bus.ECHO)
    assert steps.run(10.0).link.report(steps.port.time)[:2] == (
        ERROR, 'the board does not answer ECHO (see bus/echo)')
    outcome = steps.call(LIFT)
    assert outcome.status == NOT_SENT and 'bus/echo' in outcome.message and not steps.moves
    assert len(lines('set bus/echo to false')) == 1
    steps = Bus(QUIET._replace(echo=False), logger=logger).run(1.0)
    assert steps.call(LIFT).success and not [
        each for each in steps.requests if each.cmd1 == bus.ECHO]


@pytest.mark.parametrize('condition', Condition)
def test_each_condition_has_a_level_a_summary_and_a_word(logger, monkeypatch, condition):
    link = Bus(logger=logger).run(1.0).link
    monkeypatch.setattr(Session, 'condition', condition)
    assert link.condition(0.0) == (condition.level, condition.text)
    assert link.condition_name(0.0) == condition.word
    assert link.talks(0.0) == {Condition.READY: True, Condition.NO_SYNC: False}.get(condition)


def test_a_blocked_port_is_tried_again_only_after_a_pause(logger, lines):
    steps = Bus(logger=logger)
    steps.port.is_full = True
    tries = []
    steps.port.discard_output = lambda why='': tries.append(steps.port.time) or True
    steps.run(1.0)
    assert 1 < len(tries) <= 21 and lines('does flow control block the port?')


def test_the_tap_sees_every_frame_both_ways(logger):
    steps = Bus(logger=logger).run(1.0)
    tapped = []
    steps.link.tap = lambda name, direction, frame: tapped.append((name, direction, frame))
    steps.rule = lambda request: b'\x11\x22' + bus.encode_reply(bus.Reply(bus.OK)) \
        if request == LIFT else None
    steps.call(LIFT)
    names = [(name, direction, str(frame.message or frame.cause))
             for name, direction, frame in tapped]
    at = names.index(('bus', TX, 'lift up 100 mm'))
    assert names[at + 1:at + 3] == [('bus', RX, 'framing'), ('bus', RX, 'OK')]
    assert tapped[at][2].raw == bus.encode_request(LIFT)
