"""The panel's command line, and the node that serves the page of a bridge.

It serves at once, also without a ROS master. A thread starts ROS as soon as a master answers.
"""
import argparse
import asyncio
import logging
import os
import re
import secrets
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from typing import Callable, List

import rosgraph
import rospy
import tornado.httpserver
import tornado.ioloop
import tornado.netutil

from ...link.sparing_log import SparingLog
from ...output import prepare_output
from ...ros import logs
from ...ros.background import LatestWorker
from ...ros.master import end_within, restart, watch_master
from ..watch.calls import node_argument
from ..watch.state import BridgeState
from ..watch.topics import NODE
from ..watch.watcher import wait_for_master
from .commands import Commands, Outlet
from .feed import Feed
from .news import News
from .pages import Hub, Page
from .server import application, own_names

_STOP_TIME = 0.2          # s for the last zeros to be sent
_EXIT_TIME = 1.8          # s from a signal until the process exits, even if a thread hangs
_MAX_BODY = 4096          # bytes of a request
_BEFORE = 'SERIAL_COMMUNICATION_PANEL'    # environment of a restart: port and token


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f'{text!r} is not a port (0 … 65535)')
    return int(text)


def _token(text: str) -> str:
    if not re.fullmatch('[A-Za-z0-9._~-]{12,200}', text):     # it can be guessed over the network
        raise argparse.ArgumentTypeError(f'invalid token of {len(text)} characters: it must have '
                                         '12 … 200 of A-Z a-z 0-9 . _ ~ -')
    return text


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='panel', description='Serve a web page that shows a bridge and its links, to whoever '
        'opens the address that is printed. Ctrl-C ends it.')
    parser.add_argument('--port', type=_port, default=8080,
                        help='TCP port to listen on; 0: any free one (default: %(default)s)')
    parser.add_argument('--bind', default='127.0.0.1', metavar='ADDRESS',
                        help='address to listen on; 0.0.0.0: all (default: %(default)s)')
    parser.add_argument('--node', type=node_argument, default=NODE, metavar='NAME',
                        help="the bridge's node name (default: %(default)s)")
    parser.add_argument('--control', action='store_true',
                        help='let the page move lift, gimbal, car or base')
    parser.add_argument('--token', type=_token,
                        help='a token of your own, instead of a random one of each start. Others '
                        'can see it in ps and in the log of roslaunch')
    return parser.parse_args(rospy.myargv()[1:])


def _start_ros(stopping: threading.Event, ready: Callable[[], None], end: Callable[[int], None],
               start_again: Callable[[], None]) -> None:
    """Start this node as soon as a master answers; `start_again` at a new master."""
    def ended() -> None:
        if not stopping.is_set():       # else the page would never change again
            _print_error('ROS has ended this node (rosnode kill, or another node of its name)')
            end(1)

    if not wait_for_master(stopping, _print_error):
        return
    rospy.on_shutdown(ended)
    rospy.init_node('panel', disable_signals=True)
    logs.queue_lines()
    watch_master(start_again)
    ready()


def main() -> int:
    """Serve until a signal ends the program; return the exit status."""
    prepare_output()
    options = _arguments()
    status = 1
    try:
        status = _serve(options)
    finally:
        logs.finish(status)
    return status


def _print_error(text: str) -> None:
    print(f'panel: {text}', file=sys.stderr, flush=True)


def page_address(bind: str, port: int, token: str) -> str:
    """The address to open in a browser; browsers send the part after # to no server."""
    host = bind
    if bind in ('0.0.0.0', '::', ''):       # that of this machine in its network; else its name
        host = socket.gethostname()
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(('192.0.2.1', 9))     # sends nothing; 192.0.2.0/24 is for documentation
            host = probe.getsockname()[0]
    return f'http://{f"[{host}]" if ":" in host else host}:{port}/#{token}'


def _serve(options: argparse.Namespace) -> int:
    at, token = os.environ.pop(_BEFORE, f'{options.port} {secrets.token_urlsafe(16)}').split()
    token = options.token or token
    try:
        sockets = tornado.netutil.bind_sockets(int(at), options.bind)
    except OSError as error:
        _print_error(f'cannot listen on {options.bind} port {at}: {error.strerror}; choose '
                     'others with --bind and --port')
        return 1
    port = sockets[0].getsockname()[1]

    loop = tornado.ioloop.IOLoop.current()
    bridge = BridgeState(options.node, rosgraph.get_master_uri())
    news, worker = News(), LatestWorker('registrar')
    commands = Commands(bridge, Outlet(bridge, worker), news, loop.add_callback) \
        if options.control else None
    hub = Hub(Feed(bridge, worker, news), commands, news,
              SparingLog('panel', logging.getLogger('rosout')))
    app = application(Page, hub, own_names(options.bind), token, port)
    server = tornado.httpserver.HTTPServer(app, max_body_size=_MAX_BODY, max_header_size=1 << 14,
                                           idle_connection_timeout=60)
    server.add_sockets(sockets)
    # Printed, not logged: readers of the log must not get the token.
    print(f'panel: {page_address(options.bind, port, token)}', flush=True)
    statuses: List[int] = []

    def end(status: int = 0) -> None:
        first = not statuses        # a second signal may arrive while the first is handled
        statuses.append(status)
        if first:
            end_within(_EXIT_TIME, status)
            loop.add_callback_from_signal(loop.stop)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: end())
    stopping = threading.Event()
    threading.Thread(target=_start_ros, name='start ROS', daemon=True, args=(
        stopping, lambda: setattr(hub, 'ros_runs', True), end,
        lambda: loop.add_callback(loop.stop))).start()
    loop.add_callback(lambda: asyncio.ensure_future(hub.run()))
    loop.start()

    server.stop()
    for page in list(hub.pages):
        page.on_close()
    time.sleep(_STOP_TIME)
    if not statuses:
        restart({_BEFORE: f'{port} {token}'})
    stopping.set()
    rospy.signal_shutdown('it ends')
    return statuses[0] if statuses else 0
