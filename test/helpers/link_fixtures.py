"""For every test of a link: a time limit, and nothing left running."""
import faulthandler
import logging
import signal
import sys
import threading
import time

import pytest

from fake_boards import Line

from serial_communication.transport.port import Port

_LIMIT = 20.0      # s for one test


@pytest.fixture(autouse=True)
def time_limit():
    """A test that hangs fails, and says where every thread was."""
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
    """Every thread that a test starts has a name, and ends within a second of the test."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 1.5
    started = [thread for thread in threading.enumerate() if thread not in before]
    for thread in started:
        thread.join(max(0.0, deadline - time.monotonic()))
    left = [thread.name for thread in started if thread.is_alive()]
    assert not left, 'threads still run: %s' % left
    unnamed = [thread.name for thread in started if thread.name.startswith('Thread-')]
    assert not unnamed


@pytest.fixture
def line(tmp_path):
    """A real tty whose other end is the test's."""
    made = Line(tmp_path / 'port').plug()
    yield made
    made.unplug()


@pytest.fixture
def port(line):
    """A port that is open on it."""
    made = Port(line.path)
    made.open()
    yield made
    made.close()


@pytest.fixture
def logger(request, caplog):
    """A logger of the test's own, whose lines `lines` gives."""
    caplog.set_level(logging.DEBUG)
    return logging.getLogger('test.' + request.node.name)


@pytest.fixture
def lines(caplog):
    """The warnings and errors so far that hold a text."""
    def said(text='', level=logging.WARNING):
        return [record.getMessage() for record in list(caplog.records)
                if record.levelno >= level and text in record.getMessage()]
    return said


@pytest.fixture
def running():
    """Starts links and boards; ends them as the test ends."""
    started = []

    def start(thing):
        started.append(thing)
        thing.start()
        return thing

    yield start
    for thing in reversed(started):
        thing.stop()
    for thing in started:
        if hasattr(thing, 'join'):
            thing.join()
