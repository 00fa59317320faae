"""The web page of a bridge: a node that looks, and with --control takes commands for it.

Serves at once, with or without a ROS master; ROS is begun in a thread beside, as soon as there
is a master to register with.
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
from ..watch.watcher import leave
from .commands import Commands
from .feed import Feed
from .guard import SHORTEST_TOKEN, Guard, is_loopback
from .registrar import Registrar
from .server import Hub, listen, own_names, serve

_LAST_WORDS = 0.2         # s that a last SPEED 0 has to leave
_FAREWELL = 1.0           # s for the master to take note of the end
_LAST_RESORT = 1.8        # s from a signal to the end, whatever hangs


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f'{text!r}, may be a number from 0 to 65535')
    return int(text)


def _token(text: str) -> str:
    if not re.fullmatch(rf'[A-Za-z0-9._~-]{{{SHORTEST_TOKEN},200}}', text):
        raise argparse.ArgumentTypeError(
            f'{len(text)} characters, may be at least {SHORTEST_TOKEN} of A-Z a-z 0-9 . _ ~ -')
    return text


def _arguments(argv: List[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='panel', description='Serve a page in the browser that shows what a bridge and its '
        'lines do. Ctrl-C ends it.',
        epilog='Without options the page only looks, and only this machine can open it. An '
               'address other than 127.0.0.1, and --control, need a token: open the address that '
               'the panel prints.')
    parser.add_argument('--port', type=_port, default=8080,
                        help='where to listen; 0: any that is free (default: %(default)d)')
    parser.add_argument('--bind', default='127.0.0.1', metavar='ADDRESS',
                        help='where to listen; 0.0.0.0: for everybody (default: %(default)s)')
    parser.add_argument('--node', default=NODE, metavar='NAME',
                        help="the bridge's name (default: %(default)s)")
    parser.add_argument('--control', action='store_true',
                        help='let the page move lift, gimbal and car, too')
    parser.add_argument('--token', type=_token,
                        help='what the address has to carry (default: made anew, where needed)')
    return parser.parse_args(argv)


def _address(bind: str, port: int, token: Optional[str]) -> str:
    """What to open in a browser."""
    host = socket.gethostname() if bind in ('0.0.0.0', '::', '') else bind
    host = f'[{host}]' if ':' in host else host
    return f'http://{host}:{port}/' + (f'?token={token}' if token else '')


def _say(text: str) -> None:
    print(f'panel: {text}', file=sys.stderr, flush=True)


class _Ros:
    """The node's life: begins in a thread of its own, as soon as there is a master."""

    def __init__(self, ready: Callable[[], None], end: Callable[[int], None]) -> None:
        self._ready = ready
        self._end = end
        self._stopping = threading.Event()
        threading.Thread(target=self._begin, name='begin ROS', daemon=True).start()

    def stop(self) -> None:
        """Begin nothing any more, and leave the master."""
        self._stopping.set()
        leave(_FAREWELL)

    def _begin(self) -> None:
        if not wait_for_master(self._stopping, _say):
            return
        name = full_name('panel')
        if running_node(name):
            _say(f'another node is named {name} at {rosgraph.get_master_uri()}; end it, '
                 'or take another name with __name:=NAME')
            self._end(3)
            return
        try:
            init_node('panel', disable_signals=True)
        except rospy.ROSInitException:      # somebody took the name meanwhile
            self._over()
            return
        rospy.on_shutdown(self._over)
        if rospy.core.is_shutdown_requested():      # just now: the hook came too late
            self._over()
            return
        MasterWatch({}, logging.getLogger('rosout')).start()
        self._ready()

    def _over(self) -> None:
        """Somebody else took the name, or rosnode kill: the page would stand still for good."""
        if not self._stopping.is_set():
            self._stopping.set()
            _say('ROS has ended this node (rosnode kill, or another of its name)')
            self._end(1)


def main(argv: Optional[List[str]] = None) -> int:
    """Serve until a signal; the exit status."""
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
        _say(f'cannot listen on {options.bind} port {options.port}: {error.strerror}; '
             'choose others with --bind and --port')
        return 1

    loop = tornado.ioloop.IOLoop.current()
    log = SparingLog('panel', logging.getLogger('rosout'))
    node = rospy.names.resolve_name(options.node)
    registrar = Registrar(log)
    commands = Commands(node, registrar, loop.add_callback, loop.call_later) \
        if options.control else None
    hub = Hub(Feed(node, rosgraph.get_master_uri(), registrar), commands, log)
    server = serve(sockets, hub, Guard([*own_names(), options.bind], token))
    statuses: List[int] = []
    last_resort = LastResort(_LAST_RESORT)

    def end(status: int = 0) -> None:
        first = not statuses        # a second signal may come while the first one is taken in
        statuses.append(status)
        if first:
            last_resort.begin(status)
            loop.add_callback_from_signal(loop.stop)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: end())
    # Not to the log: whoever may read that shall not learn the token.
    print('panel: ' + _address(options.bind, sockets[0].getsockname()[1], token), flush=True)
    ros = _Ros(lambda: loop.add_callback(hub.ros_is_there), end)
    loop.start()

    server.stop()
    if hub.stop():
        time.sleep(_LAST_WORDS)
    ros.stop()
    return statuses[0]
