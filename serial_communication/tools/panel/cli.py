"""The web page of a bridge: a node that observes it, and with --control also commands it.

It serves the page at once, also without a ROS master. A thread initialises ROS as soon as a master
answers.
"""
import argparse
import logging
import os
import re
import secrets
import signal
import socket
import sys
import threading
import time
from typing import Callable, List, Optional

import rosgraph
import rospy
import tornado.ioloop

from ...link.sparing_log import SparingLog
from ...output import prepare_output
from ...ros.last_resort import LastResort
from ...ros.master import full_name, running_node, wait_for_master
from ...ros.rospy_mends import background_logging
from ...ros.rospy_mends.log_file import init_node
from ...ros.rospy_mends.master_watch import MasterWatch
from ..watch.topics import NODE
from ..watch.watcher import leave_ros
from .commands import Commands
from .feed import Feed
from .guard import MIN_TOKEN_LENGTH, Guard, is_loopback
from .registrar import Registrar
from .server import Hub, host_names, listen, serve

_MAX_TOKEN_LENGTH = 200
_STOP_TIME = 0.2          # s for the last SPEED 0 to be sent
_UNREGISTER_TIME = 1.0    # s for the master to answer
_EXIT_TIME = 1.8          # s from a signal until the process exits, even if a thread hangs


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f'{text!r} is not a port (0 … 65535)')
    return int(text)


def _token(text: str) -> str:
    if not re.fullmatch(rf'[A-Za-z0-9._~-]{{{MIN_TOKEN_LENGTH},{_MAX_TOKEN_LENGTH}}}', text):
        raise argparse.ArgumentTypeError(
            f'invalid token of {len(text)} characters: it must have {MIN_TOKEN_LENGTH} … '
            f'{_MAX_TOKEN_LENGTH} of A-Z a-z 0-9 . _ ~ -')
    return text


def _arguments(argv: List[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='panel', description='Serve a web page that shows a bridge and its links. '
        'Ctrl-C ends it.',
        epilog='Without options the page is read-only, and only this machine can open it. '
               '--control, or an address other than 127.0.0.1, needs a token: open the address '
               'that the panel prints.')
    parser.add_argument('--port', type=_port, default=8080,
                        help='TCP port to listen on; 0: any free one (default: %(default)d)')
    parser.add_argument('--bind', default='127.0.0.1', metavar='ADDRESS',
                        help='address to listen on; 0.0.0.0: all (default: %(default)s)')
    parser.add_argument('--node', default=NODE, metavar='NAME',
                        help="the bridge's node name (default: %(default)s)")
    parser.add_argument('--control', action='store_true',
                        help='let the page move lift, gimbal and car')
    parser.add_argument('--token', type=_token,
                        help='token that the address must contain (default: a new one, if needed)')
    return parser.parse_args(argv)


def _address(bind: str, port: int, token: Optional[str]) -> str:
    """The address to open in a browser."""
    host = socket.gethostname() if bind in ('0.0.0.0', '::', '') else bind
    host = f'[{host}]' if ':' in host else host
    return f'http://{host}:{port}/' + (f'?token={token}' if token else '')


def _print_error(text: str) -> None:
    print(f'panel: {text}', file=sys.stderr, flush=True)


class _Ros:
    """Starts this node in a thread as soon as a master answers, and ends it."""

    def __init__(self, ready: Callable[[], None], end: Callable[[int], None]) -> None:
        self._ready = ready
        self._end = end
        self._stopping = threading.Event()
        threading.Thread(target=self._start, name='start ROS', daemon=True).start()

    def stop(self) -> None:
        """Do not start the node any more, or unregister it from the master."""
        self._stopping.set()
        leave_ros(_UNREGISTER_TIME)

    def _start(self) -> None:
        if not wait_for_master(self._stopping, _print_error):
            return
        name = full_name('panel')
        if running_node(name):
            _print_error(f'another node is named {name} at {rosgraph.get_master_uri()}; end it, '
                         'or take another name with __name:=NAME')
            self._end(3)
            return
        try:
            init_node('panel', disable_signals=True)
        except rospy.ROSInitException:      # another node took the name meanwhile
            self._ended()
            return
        rospy.on_shutdown(self._ended)
        if rospy.core.is_shutdown_requested():      # before the hook was set
            self._ended()
            return
        MasterWatch({}, logging.getLogger('rosout')).start()
        self._ready()

    def _ended(self) -> None:
        """ROS has ended this node, so the page would never change again: end the process."""
        if not self._stopping.is_set():
            self._stopping.set()
            _print_error('ROS has ended this node (rosnode kill, or another node of its name)')
            self._end(1)


def main(argv: Optional[List[str]] = None) -> int:
    """Serve until a signal ends the program; return the exit status."""
    prepare_output()
    background_logging.install()
    status = 1
    try:
        status = _serve(argv)
    finally:
        if not background_logging.finish():
            os._exit(status)
    return status


def _serve(argv: Optional[List[str]]) -> int:
    options = _arguments(rospy.myargv(sys.argv)[1:] if argv is None else argv)
    token = options.token
    if token is None and (options.control or not is_loopback(options.bind)):
        token = secrets.token_urlsafe(16)
    try:
        sockets = listen(options.port, options.bind)
    except OSError as error:
        _print_error(f'cannot listen on {options.bind} port {options.port}: {error.strerror}; '
                     'choose others with --bind and --port')
        return 1

    loop = tornado.ioloop.IOLoop.current()
    log = SparingLog('panel', logging.getLogger('rosout'))
    node = rospy.names.resolve_name(options.node)
    registrar = Registrar(log)
    commands = Commands(node, registrar, loop.add_callback, loop.call_later) \
        if options.control else None
    hub = Hub(Feed(node, rosgraph.get_master_uri(), registrar), commands, log)
    server = serve(sockets, hub, Guard([*host_names(), options.bind], token))
    statuses: List[int] = []
    last_resort = LastResort(_EXIT_TIME)

    def end(status: int = 0) -> None:
        first = not statuses        # a second signal may arrive while the first is handled
        statuses.append(status)
        if first:
            last_resort.begin(status)
            loop.add_callback_from_signal(loop.stop)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: end())
    # Printed, not logged: readers of the log must not get the token.
    print('panel: ' + _address(options.bind, sockets[0].getsockname()[1], token), flush=True)
    ros = _Ros(lambda: loop.add_callback(hub.ros_started), end)
    loop.start()

    server.stop()
    if hub.stop():
        time.sleep(_STOP_TIME)
    ros.stop()
    return statuses[0]
