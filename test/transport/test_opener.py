"""An opener, and a real tty that disappears and returns."""
import threading
import time
from types import SimpleNamespace

import pytest

from fake_boards import until
from serial_communication.transport import opener as opener_module
from serial_communication.transport.opener import Opener
from serial_communication.transport.port import Port


@pytest.fixture
def opener(line):
    port = Port(line.path)
    made = Opener(port, 'opening')
    made.port = port
    made.start()
    yield made
    made.end()
    port.close()


def test_a_port_that_exists_is_opened_without_a_failure(opener):
    failures = []
    assert opener.open(failures.append)
    assert opener.port.is_open and not failures
    assert opener.open(failures.append), 'it is open already'


def test_an_absent_port_is_tried_with_growing_pauses_and_idle_is_called_meanwhile(
        opener, line, monkeypatch):
    """The pauses have a limit: a port is opened within 1.5 s of its return, by the pause of 1 s."""
    assert opener_module._BACK_OFF == (0.1, 1.0)
    monkeypatch.setattr(opener_module, '_BACK_OFF', (0.02, 0.1))
    failures, called, pauses = [], [], []
    tries = opener._tries
    opener._tries = SimpleNamespace(put=lambda pause: pauses.append(pause) or tries.put(pause),
                                    get=tries.get)

    def idle(now):
        called.append(now)
        return now + 0.01

    def failed(trouble):
        failures.append(trouble)
        if len(failures) == 5:
            line.plug()

    line.unplug()
    assert opener.open(failed, idle) and opener.port.is_open
    assert set(failures) == {'there is no such device; waiting for it'}
    assert pauses == [0.0, 0.02, 0.04, 0.08, 0.1, 0.1]
    assert len(called) > 10 and called == sorted(called)


def test_a_port_that_closes_at_once_is_opened_again_after_a_pause(opener):
    assert opener.open(pytest.fail)
    opener.port.close()
    began = time.monotonic()
    assert opener.open(pytest.fail)
    assert time.monotonic() - began >= 0.1


def test_end_makes_open_return_false_with_the_port_closed(opener, line):
    line.unplug()
    returned = []
    waiting = threading.Thread(target=lambda: returned.append(opener.open(lambda trouble: None)),
                               name='waiting')
    waiting.start()
    opener.end()
    until(lambda: returned)
    waiting.join()
    assert returned == [False] and not opener.port.is_open
    assert not opener.open(pytest.fail), 'it has ended'


def test_end_makes_a_read_return(opener):
    assert opener.open(pytest.fail)
    opener.end()
    assert opener.port.read(None) == b''


def test_an_error_in_idle_leaves_no_result_that_is_taken_for_a_later_one(opener, line):
    with pytest.raises(ZeroDivisionError):
        opener.open(pytest.fail, lambda now: 1 / 0)
    assert opener.open(pytest.fail) and opener.port.is_open
    opener.port.close()
    line.unplug()
    failures = []
    assert opener.open(lambda trouble: failures.append(trouble) or line.plug())
    assert opener.port.is_open and failures == ['there is no such device; waiting for it']
