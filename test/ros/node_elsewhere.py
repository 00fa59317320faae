#!/usr/bin/python3
"""The bridge's node for a test of two that start in the same moment.

HOST (environment): the host that it starts on; on another one it does not share this one's lock.
MEETING: a folder. Where the node finds its name free it leaves a file there, and goes on as soon
as there is a file `go`.
"""
import os
import sys
import time

from serial_communication.ros import node, starting

look = starting.running_node


def look_and_meet(name):
    """As one that has found the name free, and is slow to register."""
    address = look(name)
    if not address and 'MEETING' in os.environ:
        open(os.path.join(os.environ['MEETING'], str(os.getpid())), 'w').close()
        while not os.path.exists(os.path.join(os.environ['MEETING'], 'go')):
            time.sleep(0.01)
    return address


starting.running_node = look_and_meet
starting._PROGRAM += os.environ.get('HOST', '')     # part of the lock's address
if ':=' not in ''.join(sys.argv[1:2]):
    del sys.argv[1:2]       # the node's own program, in whose place this one was started
node.main()
