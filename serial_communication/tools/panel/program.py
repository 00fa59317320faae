"""The web page of a bridge: a node that observes it, and with --control also commands it.

It serves the page at once, also without a ROS master. A thread initialises ROS as soon as a master
answers.
"""
import argparse
import contextlib
import fcntl
import logging
import os
import signal
import socket
import sys
import threading
import time
import traceback
from typing import Callable, Iterator, List

import rosgraph
import rospkg
import rospy
import tornado.ioloop

from ...link.sparing_log import SparingLog
from ...ros.last_resort import LastResort
from ...ros.latest_worker import LatestWorker
from ...ros.master import full_name, running_node, wait_for_master
from ...ros.rospy_mends import background_logging, master_calls
from ...ros.rospy_mends.log_file import init_node
from ...ros.rospy_mends.master_watch import MasterWatch
from ...ros.rospy_mends.shutdown import is_shutdown_requested, leave_ros
from .addresses import free_port, listen, listener, listen_near, page_address, qr_code
from .cli import DEFAULT_PORT, print_error
from .commands import Commands
from .feed import Feed
from .guard import Entrance, Guard, is_loopback
from .server import Hub, host_names, serve

_STOP_TIME = 0.2          # s for the last SPEED 0 to be sent
_UNREGISTER_TIME = 1.0    # s for the master to answer
_EXIT_TIME = 1.8          # s from a signal until the process exits, even if a thread hangs
_MAX_NAMES = 20           # panel, panel_2 …


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
        if not wait_for_master(self._stopping, print_error):
            return
        with _other_panels_waiting():
            name = _free_name()
            if not name:
                taken = full_name('panel')
                print_error(f'another node is named {taken} at {rosgraph.get_master_uri()}; end '
                            f"it, or name this one: __name:={taken.rpartition('/')[2]}_2")
                self._end(3)
                return
            watch = MasterWatch(full_name(name), logging.getLogger('rosout'))
            try:
                init_node(name, disable_signals=True)
            except rospy.ROSInitException:      # another node took the name meanwhile
                self._ended()
                return
        rospy.on_shutdown(self._ended)
        if is_shutdown_requested():      # before the hook was set
            self._ended()
            return
        watch.start({})
        self._ready()

    def _ended(self) -> None:
        """ROS has ended this node, so the page would never change again: end the process."""
        if not self._stopping.is_set():
            self._stopping.set()
            print_error('ROS has ended this node (rosnode kill, or another node of its name)')
            self._end(1)


@contextlib.contextmanager
def _other_panels_waiting() -> Iterator[None]:
    """Let no other panel of this user choose a name until this one is registered.

    The master gives a name to the node that asks last, and ends the one that had it.
    """
    try:
        folder = os.open(rospkg.get_ros_home(), os.O_RDONLY)
    except OSError:         # it does not exist: nobody waits
        yield
        return
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def _free_name() -> str:
    """The first of panel, panel_2 … that no node has; '' if the given name is taken."""
    if '__name' in rosgraph.names.load_mappings(sys.argv):
        return '' if running_node(full_name('panel')) else 'panel'
    names = ['panel', *(f'panel_{number}' for number in range(2, _MAX_NAMES))]
    return next((name for name in names if not running_node(full_name(name))), '')


def run(options: argparse.Namespace) -> int:
    """Serve until a signal ends the program; return the exit status."""
    background_logging.install()
    master_calls.limit_time()
    status = 1
    try:
        status = _serve(options)
    finally:
        if not background_logging.finish():
            os._exit(status)
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
    try:
        sockets = _listen(options)
    except OSError as error:
        _explain_no_port(options, error)
        return 1

    loop = tornado.ioloop.IOLoop.current()
    log = SparingLog('panel', logging.getLogger('rosout'))
    node = rospy.resolve_name(options.node)
    # The pause: a page may change what it shows 100 times a second.
    registrar = LatestWorker('registrar', 0.1, lambda _error: log.error(
        'registering', traceback.format_exc()))
    registrar.start()
    commands = Commands(node, registrar, loop.add_callback, loop.call_later) \
        if options.control else None
    hub = Hub(Feed(node, rosgraph.get_master_uri(), registrar), commands, log)
    needs_token = bool(options.token or options.control or not is_loopback(options.bind))
    entrance = Entrance(needs_token, options.token)

    def print_address(words: str = '') -> None:
        # Printed, not logged: readers of the log must not get the token.
        address = page_address(options.bind, sockets[0].getsockname()[1], entrance.token)
        code = qr_code(address) if sys.stdout.isatty() and not is_loopback(options.bind) else ''
        print(f'panel: {words}{address}' + f'\n{code}'.rstrip(), flush=True)
    # In a thread: a terminal that reads nothing (Ctrl-S) would block every page, STOP included.
    printer = LatestWorker('printer', 0.0, lambda _error: None)     # the terminal may be closed
    printer.start()
    entrance.on_used = lambda: printer.submit(print_address, 'for another browser: ')
    server = serve(sockets, hub, Guard(options.bind, host_names()), entrance)
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
    print_address()
    ros = _Ros(lambda: loop.add_callback(hub.ros_started), end)
    loop.start()

    server.stop()
    if hub.stop():
        time.sleep(_STOP_TIME)
    ros.stop()
    return statuses[0]
