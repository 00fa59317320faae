"""The node serves again after it ran out of file descriptors or of memory for threads.

rospy loses what it could not do meanwhile: its loop for XML-RPC calls keeps a processor busy for
as long as there is no descriptor, the loop that connects to new publishers ends at a thread that
does not start, and a publisher whose thread did not start counts as connected. Here the first
waits for a moment, and the others try again until there is a thread.

This is written against private parts of rospy and rosgraph: see private_parts.py.
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
from .private_parts import are_known

PAUSE = 0.1     # s until the next try
_MODULES = registration, tcpros_pubsub      # what starts the threads of connections to publishers


def advice(error: OSError) -> str:
    """Why nobody can be accepted, and what to do."""
    if error.errno == errno.EMFILE:
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        return (f'out of file descriptors (ulimit -n is {limit}): nobody new is served until some '
                'are closed; end subscribers, or raise the limit before the start (ulimit -n)')
    if error.errno == errno.ENFILE:
        return ('this computer is out of file descriptors: nobody new is served until some are '
                'closed; end programs, or raise the limit (sysctl fs.file-max)')
    return f'cannot accept a connection ({error}); nobody new is served until that is over'


def _is_as_expected() -> bool:
    server = rosgraph.xmlrpc.ThreadingXMLRPCServer
    return (issubclass(server, socketserver.TCPServer) and 'get_request' not in vars(server)
            and all(module.threading is threading for module in _MODULES))


def install(log: SparingLog) -> None:
    """Have it so; to be called before rospy.init_node."""
    if not are_known(_is_as_expected, 'takes calls and connects',
                     'after a shortage of file descriptors or memory it may need a restart',
                     log.always_warn):
        return

    def get_request(self: socketserver.TCPServer) -> Tuple[Any, Any]:
        try:
            return socketserver.TCPServer.get_request(self)
        except OSError as error:
            if self.fileno() >= 0:      # not closed: the node does not end
                log.warn('accept', advice(error))
            time.sleep(PAUSE)
            raise       # which socketserver ignores

    class PatientThread(threading.Thread):
        """Starts as soon as there is memory for it."""

        def start(self) -> None:
            while True:
                try:
                    return super().start()
                except RuntimeError as error:
                    # With an identity it has been started before: that is a mistake of the caller.
                    if self.ident is not None or rospy.is_shutdown():
                        raise
                    log.warn('thread', f'{error}: a publisher is connected as soon as there is '
                                       'memory for its thread; end programs or allow more threads '
                                       '(ulimit -v, ulimit -u)')
                    time.sleep(PAUSE)

    rosgraph.xmlrpc.ThreadingXMLRPCServer.get_request = get_request
    for module in _MODULES:
        module.threading = types.SimpleNamespace(**{**vars(threading), 'Thread': PatientThread})
