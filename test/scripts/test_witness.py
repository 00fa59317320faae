"""The witness notes when it had no processor time, and how much slower its work is."""
import os
import signal
import time

import pytest
from waiting import again_if_stalled, until
from witness import LATE, PERIOD, Witness, priority_of


def test_a_witness_is_late_while_it_is_suspended_and_only_then():
    with Witness() as witness:
        def suspended():
            began = time.monotonic()
            until(lambda: time.monotonic() > began + 20 * PERIOD)
            before = witness.late(began, time.monotonic())
            os.kill(witness._process.pid, signal.SIGSTOP)
            since = time.monotonic()
            until(lambda: time.monotonic() > since + 0.3)
            os.kill(witness._process.pid, signal.SIGCONT)
            late = witness.late(since, time.monotonic())
            assert max(late) >= 0.3 - PERIOD - LATE and sum(late) < 2.0
            return not before
        again_if_stalled(suspended)
        assert witness.late(0.0, 1.0) == []


def test_the_work_of_a_witness_shows_how_much_slower_the_machine_is():
    began = time.monotonic()
    with Witness(work=0.002, period=0.01) as witness:
        witness.late(0.0, time.monotonic())     # it works
        os.kill(witness._process.pid, signal.SIGSTOP)
        since = time.monotonic()
        until(lambda: time.monotonic() > since + 1.0)
        os.kill(witness._process.pid, signal.SIGCONT)
        witness.late(since, time.monotonic())
    # 1 s without a processor, for 2 ms of work in each 10 ms of the rest of the time.
    most = (time.monotonic() - began - 1.0) / 0.01 + 1
    assert witness.slowdown > 1 + 0.95 / (most * 0.002)


def test_the_priority_of_a_process_is_that_of_its_highest_thread():
    assert priority_of(os.getpid()) == 0
    with Witness(priority=3) as witness:
        witness.late(0.0, time.monotonic())     # it runs, or has ended
        if not witness._thread.is_alive():
            pytest.skip('this user may not have real-time priority')
        assert priority_of(witness._process.pid) == 3


def test_a_promise_that_fails_each_time_is_no_stall():
    attempts = iter([False, 0, 'third'])
    assert again_if_stalled(lambda: next(attempts)) == 'third'
    with pytest.raises(AssertionError, match='failed 2 times in a row'):
        again_if_stalled(lambda: False, tries=2)
