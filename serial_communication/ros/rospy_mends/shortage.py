"""Lets the node recover after it ran out of file descriptors or of memory for threads.

Without a free descriptor, rospy's loop for XML-RPC calls uses a whole processor. If a thread does
not start, rospy's loop that connects to new publishers ends, and a publisher whose thread did not
start counts as connected. Here the first loop pauses before it tries again, and the threads are
started again and again until one starts.
"""
import errno
import resource
import socketserver
import threading
import time
import types
from typing import Any, Tuple

import rosgraph.xmlrpc
import rospy
from rospy.impl import registration, tcpros_pubsub

from ...link.sparing_log import SparingLog
from .private_parts import Guard

_GUARD = Guard('rosgraph.xmlrpc:ThreadingXMLRPCServer rospy.impl.registration:RegManager.run '
               'rospy.impl.tcpros_pubsub:TCPROSHandler.create_transport', {'9232fdb1a6aeec60'},
               'accepts calls and connects', 'after a shortage of file descriptors or memory the '
               'node may need a restart')
PAUSE = 0.1     # s until the next try
_MODULES = registration, tcpros_pubsub      # start the threads of connections to publishers


def advice(error: OSError) -> str:
    """Return why no connection can be accepted, and what to do."""
    if error.errno == errno.EMFILE:
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        return (f'out of file descriptors (ulimit -n is {limit}): no new connection is accepted '
                'until some are closed; end subscribers, or raise the limit before the start '
                '(ulimit -n)')
    if error.errno == errno.ENFILE:
        return ('this computer is out of file descriptors: no new connection is accepted until '
                'some are closed; end programs, or raise the limit (sysctl fs.file-max)')
    return f'cannot accept a connection ({error}); trying again'


def install(log: SparingLog) -> None:
    """Patch rospy, if its source is known; call this before rospy.init_node."""
    if not _GUARD.passes(log.always_warn):
        return

    def get_request(self: socketserver.TCPServer) -> Tuple[Any, Any]:
        try:
            return socketserver.TCPServer.get_request(self)
        except OSError as error:
            if self.fileno() >= 0:      # otherwise the node is shutting down
                log.warn('accept', advice(error))
            time.sleep(PAUSE)
            raise       # socketserver ignores it

    class PatientThread(threading.Thread):
        """A thread whose start waits until there is memory for it."""

        def start(self) -> None:
            while True:
                try:
                    return super().start()
                except RuntimeError as error:
                    # A thread with an identity was started before: the caller made a mistake.
                    if self.ident is not None or rospy.is_shutdown():
                        raise
                    log.warn('thread', f'{error}: the connection to a publisher waits until there '
                                       'is memory for its thread; end programs, or allow more '
                                       'threads (ulimit -v, ulimit -u)')
                    time.sleep(PAUSE)

    rosgraph.xmlrpc.ThreadingXMLRPCServer.get_request = get_request
    for module in _MODULES:
        module.threading = types.SimpleNamespace(**{**vars(threading), 'Thread': PatientThread})
