"""The Master against a board whose line loses, delays, doubles and damages: what callers are told
is true. See `bus_model` for the faults."""
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from bus_model import FAULTS, MOTION_TIMEOUT, REQUESTS, Model

# Faults on every second exchange or so.
faults = st.lists(st.one_of(st.just('none'), st.sampled_from(FAULTS)), max_size=60)
pauses = st.sampled_from((0.0, 0.0, 0.005, 0.02, 0.3, 0.51, 1.0, 2.5))
steps = st.lists(st.tuples(st.sampled_from(REQUESTS + ('lift', 'raw', 'replug')), pauses),
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


@given(faults, steps, st.booleans())
@settings(max_examples=max(400, settings.default.max_examples))
def test_what_callers_are_told_is_true(board_faults, script, echoes):
    # A board without ECHO has nothing but a silence to tell late replies from others.
    late = () if echoes else ('very late', 'late')
    play(Model([fault for fault in board_faults if fault not in late], echoes), script)


@pytest.mark.parametrize('fault', FAULTS)
@pytest.mark.parametrize('kind', REQUESTS)
def test_every_fault_at_every_exchange(fault, kind):
    """One fault, or one on every second exchange, wherever it falls."""
    for at in range(6):
        for every in (1, 2):
            model = Model(['none'] * at + [fault, 'none'] * every)
            play(model, [(kind, 0.0), ('raw', 0.02), (kind, 0.0), ('lift', 3.0), (kind, 0.0)])
            model.board.heal()
            for again in REQUESTS:      # nothing of the fault is left
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
    assert len(model.board.executed) == 80 and model.master.timeouts == 0


def test_a_dead_board_answers_nobody_and_everybody_is_told():
    model = Model(['lose request'] * 10000)
    for kind in REQUESTS:
        model.submit(kind)
    model.run(MOTION_TIMEOUT + 1.0)
    model.check_all_answered()
    assert model.board.executed == []


class Session(RuleBasedStateMachine):
    """The same with hypothesis at the wheel: faults are chosen as the session goes."""

    def __init__(self):
        super().__init__()
        self._next_faults = []
        self.model = Model(self._faults())

    def _faults(self):
        while True:
            yield self._next_faults.pop(0) if self._next_faults else 'none'

    @rule(kind=st.sampled_from(REQUESTS))
    def call(self, kind):
        self.model.submit(kind)

    @rule(fault=st.sampled_from(FAULTS))
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
    def told_the_truth(self):
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
