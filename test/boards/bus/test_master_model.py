"""The Master against a board whose line loses, delays, doubles and damages: every outcome is true.

See `bus_model` for the faults.
"""
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bus_model import FAULTS, POLLS, REPLY_TIMEOUT, REQUESTS, Model

from serial_communication.boards.bus.master import FENCE_SILENCE

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
steps = st.lists(st.tuples(st.sampled_from(REQUESTS + POLLS + (
    'lift', 'raw', 'close', 'open', 'give up')), pauses), min_size=1, max_size=20)


def play(model, script):
    for what, pause in script:
        if what == 'close':
            model.disconnect()
        elif what == 'open':
            model.connect()
        elif what == 'give up':
            model.asked and model.asked[-1].call.wait(0.0)
        else:
            model.submit(what)
        model.run(pause)
        model.check()
    model.connect()
    model.run(60.0)
    model.check()
    model.check_all_answered()
    assert model.master.synchronised and model.master.in_step


@given(boards, steps, st.sampled_from((b'', b'\0', bytes(6))))
@settings(max_examples=max(400, settings.default.max_examples))
def test_outcomes_are_true(board, script, ok_data):
    faults, echoes = board
    play(Model(faults, echoes, ok_data), script)


def test_without_echo_a_reply_to_the_sync_before_a_stop_is_no_fence():
    """It arrives behind the next SYNC; the reply to the stop is still under way."""
    faults = ['none', ('late', 0.25), 'none', 'damage request']
    play(Model(faults, False), [('lift', 0.0), ('stop', 0.0)])


@pytest.mark.parametrize('fault', FAULTS, ids=str)
@pytest.mark.parametrize('kind', REQUESTS)
def test_every_fault_at_every_exchange(fault, kind):
    """And at the one after the next."""
    for at in range(6):
        model = Model(['none'] * at + [fault, 'none', fault])
        play(model, [(kind, 0.0), ('raw', 0.02), (kind, 0.0), ('lift', 3.0), (kind, 0.0)])
    model.board.heal()
    for again in REQUESTS:      # the faults have no later effect
        model.submit(again)
        model.run(0.1)
        assert model.asked[-1].call.outcome.success
    model.check()
