"""The web page of a bridge: a node that observes it, and with --control also commands it.

It serves the page at once, also without a ROS master. A thread initialises ROS as soon as a master
answers.
"""
import argparse
import logging
import os
import secrets
import signal
import socket
import sys
import threading
import time
from typing import Callable, List

import rosgraph
import rospy
import tornado.ioloop

from ...link.sparing_log import SparingLog
from ...ros import logs
from ...ros.background import LatestWorker
from ...ros.master import (NAME_TAKEN, end_within, full_name, restart, running_node,
                           watch_master)
from ..watch.master import wait_for_master
from .addresses import free_port, listen, listener, listen_near, page_address, qr_code
from .cli import DEFAULT_PORT, print_error
from .commands import Commands
from .feed import Feed
from .guard import Entrance, Guard, is_loopback
from .server import Hub, host_names, serve

_STOP_TIME = 0.2          # s for the last SPEED 0 to be sent
_EXIT_TIME = 1.8          # s from a signal until the process exits, even if a thread hangs
_BEFORE = 'SERIAL_COMMUNICATION_PANEL'    # environment of a restart: port and token


class _Ros:
    """Starts this node in a thread as soon as a master answers, and ends it."""

    def __init__(self, ready: Callable[[], None], end: Callable[[int], None],
                 start_again: Callable[[], None]) -> None:
        self._ready = ready
        self._end = end
        self._start_again = start_again     # at a new master
        self._stopping = threading.Event()
        threading.Thread(target=self._start, name='start ROS', daemon=True).start()

    def stop(self) -> None:
        """Do not start the node any more, or unregister it from the master."""
        self._stopping.set()
        rospy.signal_shutdown('it ends')

    def _start(self) -> None:
        if not wait_for_master(self._stopping, print_error):
            return
        name = full_name('panel')
        if running_node(name):
            print_error(f'another node is named {name} at {rosgraph.get_master_uri()}; end it, or '
                        f"name this one: __name:={name.rpartition('/')[2]}_2")
            self._end(NAME_TAKEN)
            return
        rospy.on_shutdown(self._ended)
        try:
            rospy.init_node('panel', disable_signals=True)
        except rospy.ROSInitException:      # another node took the name meanwhile
            self._ended()
            return
        logs.queue_lines()
        watch_master(self._start_again)
        self._ready()

    def _ended(self) -> None:
        """ROS has ended this node, so the page would never change again: end the process."""
        if not self._stopping.is_set():
            self._stopping.set()
            print_error('ROS has ended this node (rosnode kill, or another node of its name)')
            self._end(1)


def run(options: argparse.Namespace) -> int:
    """Serve until a signal ends the program; return the exit status."""
    status = 1
    try:
        status = _serve(options)
    finally:
        logs.finish(status)
    return status


def _listen(options: argparse.Namespace) -> List[socket.socket]:
    """Listen where the options say; OSError if that is not possible."""
    if options.port is not None:
        return listen(options.port, options.bind)
    sockets = listen_near(DEFAULT_PORT, options.bind)
    if sockets[0].getsockname()[1] != DEFAULT_PORT:
        print_error(f'port {DEFAULT_PORT} is taken by {listener(DEFAULT_PORT) or "another program"}'
                    '; the next free one is used')
    return sockets


def _explain_no_port(options: argparse.Namespace, error: OSError) -> None:
    """Print why it cannot listen, who has the port, and which one is free."""
    port = DEFAULT_PORT if options.port is None else options.port
    held_by, free = listener(port), free_port(port, options.bind)
    print_error(f'cannot listen on {options.bind} port {port}: {error.strerror}'
                + (f', by {held_by}' if held_by else '')
                + ('; ' + (f'free: --port {free}' if free else 'choose others with --bind and '
                           '--port')))


def _serve(options: argparse.Namespace) -> int:
    before, _, token = os.environ.pop(_BEFORE, '').partition(' ')
    if before:
        options.port = int(before)
    try:
        sockets = _listen(options)
    except OSError as error:
        _explain_no_port(options, error)
        return 1

    loop = tornado.ioloop.IOLoop.current()
    log = SparingLog('panel', logging.getLogger('rosout'))
    node = rospy.resolve_name(options.node)
    registrar = LatestWorker('registrar')
    commands = Commands(node, registrar, loop.add_callback, loop.call_later) \
        if options.control else None
    hub = Hub(Feed(node, rosgraph.get_master_uri(), registrar), commands, log)
    needs_token = bool(options.token or options.control or not is_loopback(options.bind))
    entrance = Entrance((options.token or token or secrets.token_urlsafe(16)) if needs_token
                        else None)
    port = sockets[0].getsockname()[1]
    # Printed, not logged: readers of the log must not get the token.
    address = page_address(options.bind, port, entrance.token)
    code = qr_code(address) if sys.stdout.isatty() and not is_loopback(options.bind) else ''
    print(f'panel: {address}' + f'\n{code}'.rstrip(), flush=True)
    server = serve(sockets, hub, Guard(options.bind, host_names()), entrance)
    statuses: List[int] = []

    def end(status: int = 0) -> None:
        first = not statuses        # a second signal may arrive while the first is handled
        statuses.append(status)
        if first:
            end_within(_EXIT_TIME, status)
            loop.add_callback_from_signal(loop.stop)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: end())
    ros = _Ros(lambda: loop.add_callback(hub.ros_started), end,
               lambda: loop.add_callback(loop.stop))
    loop.start()

    server.stop()
    if hub.stop():
        time.sleep(_STOP_TIME)
    if not statuses:
        restart({_BEFORE: f'{port} {entrance.token or ""}'})
    ros.stop()
    return statuses[0] if statuses else 0
