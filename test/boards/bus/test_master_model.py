"""The Master against a board whose line loses, delays, doubles and damages: every outcome is true.

See `bus_model` for the faults.
"""
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from bus_model import (FAULTS, MOTION_TIMEOUT, POLLS, REPLY_TIMEOUT, REQUESTS, TEST, Model)

from serial_communication.boards.bus import master as master_module
from serial_communication.boards.bus.master import FENCE_SILENCE, Master, SessionState
from serial_communication.boards.bus import wire as bus

# Faults on about every second exchange. On a board without ECHO, only a silence of 20 ms before a
# request that needs a fence tells late replies from others.
seconds = st.floats(0.0, 3.0)
any_fault = st.one_of(st.sampled_from(FAULTS), st.tuples(st.just('late'), seconds),
                      st.tuples(st.just('double'), seconds))
fault_without_echo = st.one_of(
    st.sampled_from([fault for fault in FAULTS if not isinstance(fault, tuple)]),
    st.tuples(st.just('late'), st.floats(0.0, REPLY_TIMEOUT - 0.1)),
    st.tuples(st.just('double'), st.floats(0.0, FENCE_SILENCE - 0.001)))


@pytest.fixture(autouse=True)
def time_limit():
    """No limit: no port can block, and the duration depends on the machine only."""


def some(fault):
    return st.lists(st.one_of(st.just('none'), fault), max_size=60)


boards = st.one_of(st.tuples(some(any_fault), st.just(True)),
                   st.tuples(some(fault_without_echo), st.just(False)))
pauses = st.sampled_from((0.0, 0.0, 0.005, 0.02, 0.3, 0.51, 1.0, 2.5))
steps = st.lists(st.tuples(st.sampled_from(REQUESTS + POLLS + ('lift', 'raw', 'replug')), pauses),
                 min_size=1, max_size=20)


def play(model, script):
    for what, pause in script:
        if what == 'replug':
            model.disconnect()
            model.run(0.1)
            model.connect()
        else:
            model.submit(what)
        model.run(pause)
        model.check()
    model.run(60.0)
    model.check()
    model.check_all_answered()


@given(boards, steps, st.sampled_from((b'', b'\0', bytes(6))))
@settings(max_examples=max(400, settings.default.max_examples))
def test_outcomes_are_true(board, script, ok_data):
    faults, echoes = board
    play(Model(faults, echoes, ok_data), script)


def test_a_board_whose_first_echoes_are_late_counts_as_echoing():
    """The first ECHO is lost, and the others return after all three timed out. The doubled OK of a
    lift must then not be taken for the reply to the next lift, which is lost."""
    faults = ['none', 'lose request', ('late', 2 * REPLY_TIMEOUT + 0.2), 'none', 'none',
              ('double', FENCE_SILENCE + 0.001), 'lose request']
    play(Model(faults, True, b''), [('lift', 0.3), ('lift', 0.0), ('lift', 0.0)])


# The board sends OK twice, the second time just after it received the next request.
TWICE_AND_REFUSED = [('lift', 0.012), ('lift', 3.0)]


def test_a_doubled_ok_does_not_hide_a_refusal():
    """The exchanges: SYNC, ECHO, a lift, the next fence, and a lift that is refused."""
    model = Model(['none', 'none', ('double', 0.005), 'none', 'error'])
    play(model, TWICE_AND_REFUSED)
    assert [asked.call.outcome.status for asked in model.asked] == [bus.OK, bus.ERROR]


@pytest.mark.parametrize('fault', ['error', 'too long', 'damage request'])
def test_a_doubled_ok_does_not_hide_the_refusal_of_a_repeatable_function(fault):
    model = Model(['none', 'none', ('double', 0.005), 'none', fault, 'none', fault, 'none', fault])
    play(model, [('lift', 0.012), ('test', 3.0)])
    assert model.asked[-1].call.outcome.status in (bus.ERROR, bus.INVALID)
    assert bus.Request(bus.FUNCTION, TEST, b't\1\0\0') not in model.board.executed


@pytest.mark.parametrize('echoes', [True, False], ids=('echoes', 'never echoes'))
def test_polls_of_equal_length_get_their_own_values_from_doubled_replies(echoes):
    model = Model([('double', 0.005)] * 1000, echoes)
    model.run(10.0)
    for _ in range(50):
        for kind in POLLS:
            model.submit(kind)
        model.run(5.0)
        model.check()
    assert sum(asked.call.outcome.success for asked in model.asked) == 150


def test_the_model_detects_a_missing_fence(monkeypatch):
    monkeypatch.setattr(Master, '_needs_fence', lambda self, call: False)
    with pytest.raises(AssertionError, match='executed 0 times'):
        play(Model(['none', 'none', ('double', 0.005), 'error']), TWICE_AND_REFUSED)


def test_the_model_detects_a_missing_silence_before_a_move(monkeypatch):
    """On a board without ECHO: SYNC, three ECHOs, SYNC and a silence come first."""
    faults = ['none'] * 5 + [('double', 0.005), 'error']
    play(Model(faults, echoes=False), [('sync', 3.0)] + TWICE_AND_REFUSED)
    monkeypatch.setattr(master_module, 'FENCE_SILENCE', 0.0)
    with pytest.raises(AssertionError, match='executed 0 times'):
        play(Model(faults, echoes=False), [('sync', 3.0)] + TWICE_AND_REFUSED)


@pytest.mark.parametrize('has_fence, faults, script', [
    (lambda call: not call.function.repeatable, ['none', 'none', ('double', 0.005), 'error'],
     [('lift', 0.012), ('test', 0.5)]),
    (lambda call: not call.poll, ['none', 'none'] + [('double', 0.005)] * 3,
     [('poll one', 0.012), ('poll two', 0.5)])], ids=('repeatable', 'poll'))
def test_the_model_detects_a_fence_missing_for_some_requests(monkeypatch, has_fence, faults,
                                                             script):
    monkeypatch.setattr(Master, '_needs_fence', lambda self, call: has_fence(call))
    with pytest.raises(AssertionError, match='was reported'):
        play(Model(faults), script)


def test_the_model_detects_a_function_sent_to_another_board(monkeypatch):
    faults = ['none', 'none', 'none', 'none', 'reset']
    play(Model(faults), [('own', 0.1), ('own', 3.0), ('own', 3.0)])
    monkeypatch.setattr(Model, '_begun_anew', lambda self, now: None)
    with pytest.raises(AssertionError, match='sent to another board'):
        play(Model(faults), [('own', 0.1), ('own', 3.0), ('own', 3.0)])


def test_the_model_detects_a_stop_that_waits(monkeypatch):
    monkeypatch.setattr(Master, '_interrupt', lambda self, call, now: None)
    with pytest.raises(AssertionError, match='the stop was not sent at once'):
        play(Model(), [('sync', 1.0), ('lift', 0.0), ('stop', 1.0)])


def test_moves_succeed_with_data_in_the_ok():
    model = Model(ok_data=b'\1\2')
    for kind in ('lift', 'gimbal', 'act') * 10:
        model.submit(kind)
        model.run(0.1)
        assert model.asked[-1].call.outcome.success
    model.check()


@pytest.mark.parametrize('fault', FAULTS, ids=str)
@pytest.mark.parametrize('kind', REQUESTS)
def test_every_fault_at_every_exchange(fault, kind):
    """One fault at each exchange, and one at every second exchange."""
    for at in range(6):
        for every in (1, 2):
            model = Model(['none'] * at + [fault, 'none'] * every)
            play(model, [(kind, 0.0), ('raw', 0.02), (kind, 0.0), ('lift', 3.0), (kind, 0.0)])
            model.board.heal()
            for again in REQUESTS:      # the fault has no later effect
                model.submit(again)
                model.run(0.1)
                assert model.asked[-1].call.outcome.success
            model.check()


def test_without_faults_every_call_succeeds_at_once():
    model = Model()
    for kind in REQUESTS * 20:
        model.submit(kind)
        model.run(0.05)
        assert model.asked[-1].call.outcome.success
    model.check()
    # A stop is sent twice: at once, and behind a fence.
    assert len(model.board.executed) == 200 and model.master.timeouts == 0


def test_every_request_but_sync_echo_and_the_latest_poll_has_a_fence():
    model = Model()
    model.run(0.1)
    assert model.master.state is SessionState.FENCED
    for kind, fences in (('lift', 0), ('lift', 1), ('air', 1), ('air', 1), ('read', 1),
                         ('test', 1), ('act', 1), ('raw', 1), ('echo', 0), ('sync', 0),
                         ('gimbal', 1), ('poll air', 1),
                         ('poll air', 0), ('air', 1), ('poll air', 0), ('poll one', 1),
                         ('poll one', 0), ('poll two', 1), ('poll one', 1), ('echo', 0),
                         ('poll one', 1)):
        before = model.board.echoed
        model.submit(kind)
        model.run(0.1)
        assert model.asked[-1].call.outcome.success
        assert model.board.echoed - before - (kind == 'echo') == fences, kind


def test_every_call_to_a_dead_board_has_an_outcome():
    model = Model(['lose request'] * 10000)
    for kind in REQUESTS:
        model.submit(kind)
    model.run(MOTION_TIMEOUT + 1.0)
    model.check_all_answered()
    assert model.board.executed == []


class Session(RuleBasedStateMachine):
    """The same, with faults that hypothesis chooses during the session."""

    def __init__(self):
        super().__init__()
        self._next_faults = []
        self.model = Model(self._faults())

    def _faults(self):
        while True:
            yield self._next_faults.pop(0) if self._next_faults else 'none'

    @rule(kind=st.sampled_from(REQUESTS + POLLS))
    def call(self, kind):
        self.model.submit(kind)

    @rule(fault=any_fault)
    def fail_next(self, fault):
        self._next_faults.append(fault)

    @rule(pause=pauses)
    def wait(self, pause):
        self.model.run(pause)

    @rule()
    def close(self):
        self.model.disconnect()

    @rule()
    def open(self):
        self.model.connect()

    @rule(number=st.integers(0, 20))
    def a_caller_gives_up(self, number):
        if number < len(self.model.asked):
            self.model.asked[number].call.wait(0.0)

    @invariant()
    def outcomes_are_true(self):
        self.model.check()

    def teardown(self):
        self.model.connect()
        self.model.run(60.0)
        self.model.check()
        self.model.check_all_answered()
        assert self.model.master.synchronised and self.model.master.in_step


TestSession = Session.TestCase
TestSession.settings = settings(max_examples=max(100, settings.default.max_examples),
                                stateful_step_count=40)
