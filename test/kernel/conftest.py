"""For tests with a port or a link of real time: a time limit, no thread is left, a line."""
import faulthandler
import signal
import sys
import threading
import time

import pytest

from lines import Pty
from waiting import PATIENCE

from serial_communication.link import freshness
from serial_communication.transport.port import Port

_LIMIT = 2 * PATIENCE     # s for one test
_NEVER = 1e9       # s


@pytest.fixture(autouse=True)
def time_limit():
    """Let a test that hangs fail, and print where every thread was."""
    def expired(_number, _frame):
        faulthandler.dump_traceback(sys.__stderr__)
        raise TimeoutError('the test took more than %g s' % _LIMIT)

    before = signal.signal(signal.SIGALRM, expired)
    signal.setitimer(signal.ITIMER_REAL, _LIMIT)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def every_thread_ends():
    """Check that every thread that a test starts has a name and ends within 1.5 s of the test."""
    before = set(threading.enumerate())
    yield
    started = [thread for thread in threading.enumerate() if thread not in before]
    for _ in range(150):        # a stall of this machine is only one of these turns
        if any(thread.is_alive() for thread in started):
            time.sleep(0.01)
    left = [thread.name for thread in started if thread.is_alive()]
    assert not left, 'threads still run: %s' % left
    unnamed = [thread.name for thread in started if thread.name.startswith('Thread-')]
    assert not unnamed


@pytest.fixture(autouse=True)
def this_machine_stalls_no_link(monkeypatch):
    """Links do not drop what waited while this machine gave them no processor time."""
    monkeypatch.setattr(freshness, 'STALL', _NEVER)


@pytest.fixture
def line(tmp_path):
    """A real tty; the test has its other end."""
    made = Pty(tmp_path / 'port').plug()
    yield made
    made.unplug()


@pytest.fixture
def port(line):
    """A port that is open on `line`."""
    made = Port(line.path)
    made.open()
    yield made
    made.close()


@pytest.fixture
def running():
    """A function that starts a link, which is stopped when the test ends."""
    started = []

    def start(link):
        started.append(link)
        link.start()
        return link

    yield start
    for link in started:
        link.stop()
    for link in started:
        link.join()
