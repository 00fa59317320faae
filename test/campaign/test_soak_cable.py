"""The campaign's cable, a real one, as it freezes: its far end is full, so that all that the bridge
writes afterwards stays in its own end, where its flush reaches it."""
import os
import signal
import sys
from types import SimpleNamespace

import pytest
import serial
from waiting import until

from campaign.stage import FILLING, Cable
from processes import Child

# A bridge that writes a byte each ms, asks meanwhile whether it may write, and drops what waits
# whenever it may not.
WRITER = """
import os, sys, termios, time
fd = os.open(sys.argv[1], os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
due = time.monotonic()
while True:
    try:
        os.write(fd, b'b' if time.monotonic() > due else b'')
    except BlockingIOError:
        termios.tcflush(fd, termios.TCOFLUSH)
    if time.monotonic() > due:
        due += 0.001
"""


@pytest.fixture(name='stage')
def fixture_stage(tmp_path):
    """As much of one as a cable needs."""
    children = []

    def child(name, command, priority=0):
        children.append(Child(name, command, str(tmp_path), dict(os.environ), priority))
        return children[-1]

    yield SimpleNamespace(folder=str(tmp_path), child=child,
                          end=lambda one, number: one.end(number),
                          events=SimpleNamespace(write=lambda **_: None))
    for each in children:
        each.end(signal.SIGKILL)


def test_the_bridge_does_not_drop_what_fills_the_line_as_it_freezes(stage):
    cable = Cable(stage, 'arduino')
    cable.plug()
    for _ in range(10):
        far = serial.Serial(cable.far, timeout=0.2)
        bridge = stage.child('bridge', [sys.executable, '-c', WRITER, cable.near])
        until(lambda: far.read(1), 'it writes')     # pylint: disable=cell-var-from-loop
        cable.freeze(bridge)
        bridge.end(signal.SIGKILL)
        cable.thaw()
        came = b''.join(iter(lambda: far.read(65536), b''))     # until nothing comes any more
        assert came.strip(b'b') == bytes(FILLING)
        far.close()
