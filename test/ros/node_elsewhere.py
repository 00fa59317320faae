#!/usr/bin/python3
"""The bridge's node, for tests of two nodes that start at the same time.

Environment:
HOST: the name of the host that it seems to run on. Nodes with different HOSTs do not share a lock.
WAITS: s for which it waits for the lock.
MEETING: a folder. A node that has found its name free creates a file there, and continues when the
folder has a file `go`.
INTERRUPTED: if it is set, the node gets SIGINT just before it starts again.
"""
import os
import signal
import sys
import time

from serial_communication.ros import node, starting

look = starting.running_node
execve = os.execve


def look_and_meet(name):
    """Check the name, then wait before registering."""
    address = look(name)
    if not address and 'MEETING' in os.environ:
        open(os.path.join(os.environ['MEETING'], str(os.getpid())), 'w').close()
        while not os.path.exists(os.path.join(os.environ['MEETING'], 'go')):
            time.sleep(0.01)
    return address


def execve_interrupted(*arguments):
    """Replace this process's program, once it got SIGINT."""
    os.kill(os.getpid(), signal.SIGINT)
    execve(*arguments)


if 'INTERRUPTED' in os.environ:
    os.execve = execve_interrupted
starting.running_node = look_and_meet
starting._LOCK_PATIENCE = float(os.environ['WAITS'])
starting._PROGRAM += os.environ.get('HOST', '')     # part of the lock's address
if ':=' not in ''.join(sys.argv[1:2]):
    del sys.argv[1:2]       # the path of the node's program, which this program replaces
node.main()
