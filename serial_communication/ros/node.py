"""The node: checks the parameters, connects the links with ROS, and stops them in order."""
import gc
import logging
import os
import signal
import sys
import time
from contextlib import contextmanager
from functools import partial
from typing import Any, Iterator, List, Type

import rospy
from std_srvs.srv import Trigger, TriggerResponse

from serial_communication.srv import Release, ReleaseResponse

from ..boards import BOARDS, description, reason
from ..framing.layout import readable
from ..link.link import Link
from ..link.sparing_log import SparingLog
from ..link.unknown_bytes import OtherBoard
from ..output import prepare_output
from ..transport.pace import set_priority_of_all
from . import parameters, starting
from .announced import forget_announced
from .diagnostics import Diagnostics, log_fault
from .geometry import publish_mounts
from .interface import Interface, LinkOptions
from .last_resort import LastResort
from .latest_worker import LatestWorker
from .master import full_name, started_by_roslaunch
from .parameter import ParameterError
from .rospy_mends import (background_logging, direct, handshake, log_file, master_calls, own_names,
                          shortage)
from .rospy_mends.master_watch import MasterWatch, merged
from .rospy_mends.shutdown import is_shutdown_requested
from .settings import PAUSE as SETTINGS_PAUSE
from .settings import serve as serve_settings
from .stop import Stop
from .traffic import Traffic

_SWITCH_INTERVAL = 0.0005   # s; so that a busy thread does not delay the heartbeat
_NAME = 'serial_communication'    # the default
_PRIORITY = 1               # real-time priority of all threads, if the system allows it
_SHUTDOWN = 1.0             # s for all links to end
_ANNOUNCEMENT_PAUSE = 1.0   # s: a board may change its announcement all the time
_LAST_RESORT = 1.5          # s from a signal until the process ends, even if something hangs
_LOGGER = logging.getLogger('rosout')    # rospy's, for terminal, file and /rosout


def main() -> None:
    """Run until ROS or a signal ends the node, then exit."""
    prepare_output()
    starting.check_arguments(sys.argv[1:])
    sys.setswitchinterval(_SWITCH_INTERVAL)
    background_logging.install()
    master_calls.limit_time()
    if full_name(_NAME) != f'/{_NAME}':     # one of several robots: its lines have its name
        os.environ.setdefault('ROSCONSOLE_FORMAT', '[${severity}] [${time}] ${node}: ${message}')
    start = starting.Start(_NAME)
    last_resort = LastResort(_LAST_RESORT, start.force_exit)
    status = 1
    try:
        status = _run(start, last_resort)
    finally:
        if status:      # rospy's own shutdown begins it with 0
            last_resort.begin(status)
        written = background_logging.finish()
        start.restart_if_displaced()
        if not written:
            os._exit(status)
    last_resort.begin(status)
    sys.exit(status)


def _run(start: starting.Start, last_resort: LastResort) -> int:
    status = start.wait_until_allowed()
    if status is not None:
        return status
    log = SparingLog('ROS', _LOGGER)
    handshake.install(log)
    shortage.install(log)
    master_calls.install(starting.say, log.always_warn)
    watch = MasterWatch(full_name(_NAME), _LOGGER)
    if start.stopping.is_set():
        return 0
    mistake = _mistake_of_command_line()
    if mistake:
        start.registered()
        starting.say(mistake)
        if started_by_roslaunch():      # which would start it again, with the same mistake
            start.stopping.wait()
        return 1
    # From now on a signal ends the process, even if the import of a board or the master hangs
    # before there is a bridge to stop.
    rospy.on_shutdown(last_resort.begin)
    try:
        log_file.init_node(_NAME)
    except (rospy.ROSInitException, rospy.ROSInterruptException) as error:
        if is_shutdown_requested():
            return 0
        rospy.logfatal(error)
        return 1
    finally:
        start.registered()
    direct.install(_LOGGER.warning)
    own_names.install(_LOGGER.warning)
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:    # nohup ignores it
        signal.signal(signal.SIGHUP, lambda *_: _hang_up(start))
    bridge = None
    try:
        given = _given()
        values, warnings = parameters.check(given, rospy.get_name())
        forget_announced(given, [board.NAME for board in parameters.announcing(values['boards'])])
        for warning in warnings:
            rospy.logwarn(warning)
        bridge = Bridge(values, given)
        rospy.on_shutdown(bridge.stop)
        if not is_shutdown_requested():      # otherwise nothing may call `stop` later
            # A full garbage collection looks at all that is imported. It takes 24 ms, or more on a
            # slow computer, and holds Python's lock meanwhile, so no heartbeat is sent.
            gc.freeze()
            bridge.start()
            watch.start(given)
    except rospy.ROSInterruptException:
        return 0
    except (ParameterError, *own_names.NAME_ERRORS) as error:
        if bridge:
            bridge.stop()
        rospy.logfatal(own_names.explained(error))
        starting.wait_under_roslaunch()
        return 1
    rospy.spin()
    return 0


def _mistake_of_command_line() -> str:
    """Return what is wrong with a parameter of the command line that no master would take."""
    try:
        given = master_calls.parameters_of(sys.argv, _LOGGER.warning)
        parameters.check_command_line(given, full_name(_NAME))
    except (ParameterError, rospy.ROSInitException) as error:
        return readable(' '.join(str(error).split()))
    return ''


def _given() -> Any:
    """Return the node's private parameters, as they are given."""
    for name in set(starting.empty_ports()) & set(BOARDS):
        rospy.set_param(f'~{name}/port', '')
    given = rospy.get_param('~', {})
    if not isinstance(given, dict):
        return given
    return merged(master_calls.parameters_of(sys.argv, _LOGGER.warning), given)


def _hang_up(start: starting.Start) -> None:
    start.stopping.set()
    rospy.signal_shutdown('the terminal has gone')


@contextmanager
def _errors_naming(board: Type[Interface]) -> Iterator[None]:
    """Turn what a board's code raises at the start into a ParameterError that names the board."""
    try:
        yield
    except own_names.NAME_ERRORS:
        raise       # its text names the topic or service
    except (Exception, SystemExit) as error:  # pylint: disable=broad-except
        named_by = '' if board in parameters.BUILT_IN else \
            f'parameter {rospy.resolve_name("~boards")}: '
        raise ParameterError(f'{named_by}the board {board.NAME} ({board.__module__}) cannot start: '
                             f'{reason(error)}') from None


def _recognisable(p: dict, given: dict) -> List[OtherBoard]:
    """The boards whose frames a link recognises on the wrong port."""
    return [OtherBoard(board.name, partial(board.decoder, False, given.get(board.name) or {}),
                       bool(p[f'{board.name}/port']))
            for board in map(description, (*BOARDS, *given.get('boards', ())))]


def _earlier(stamp: rospy.Time, seconds: float) -> rospy.Time:
    """Return the time so many seconds before `stamp`; ROS has none before 0."""
    nanoseconds = stamp.secs * 1_000_000_000 + stamp.nsecs - int(seconds * 1e9)
    earlier = rospy.Time.__new__(rospy.Time)     # in half the time of the call
    earlier.secs, earlier.nsecs = divmod(max(nanoseconds, 0), 1_000_000_000)
    return earlier


def _offer_lending(link: Link) -> None:
    rospy.Service(f'~{link.name}/release', Release, lambda request: ReleaseResponse(
        *link.lending.lend(request.by, request.seconds)))
    rospy.Service(f'~{link.name}/reset', Trigger, lambda _: TriggerResponse(
        *link.lending.reset()))


class Bridge:
    """All links that have a port, with their diagnostics, transforms and serial_msg.

    Args:
        p: the checked parameters.
        given: the same parameters as they were given.
    """

    def __init__(self, p: dict, given: dict) -> None:
        link_options = LinkOptions(p['frame_timeout'], rospy.Time.now, _LOGGER,
                                   _recognisable(p, given), _earlier)
        boards = [(board, values) for board, values in (
            (board, parameters.of_board(board, p)) for board in p['boards']) if values['port']]
        self._interfaces, self._links = [], []
        for board, values in boards:
            with _errors_naming(board):
                interface = board(values, link_options)
                if not isinstance(interface.link, Link):
                    raise TypeError(f'its link is {interface.link!r}, must be a Link')
                interface.link.lending.line = values['reset_line']
                self._interfaces.append(interface)
                self._links.append(interface.link)
        if not self._links:
            ports = ', '.join(f'{board.NAME}/port' for board in p['boards'])
            rospy.logwarn(f'no port is set ({ports}): the bridge has nothing to do')
        off = [board.NAME for board in p['boards'] if not parameters.of_board(board, p)['port']]
        if self._links and off:
            rospy.loginfo(f'off, because no port is set: {", ".join(off)} (bridge.launch: if a '
                          'port is given as an argument, links without a port argument are off)')
        self._mounts = publish_mounts(p['base_frame_id'], {
            values[f'{name}_frame_id']: values[f'{name}_mount']
            for board, values in boards for name in board.MOUNTS})
        self.stop_service = Stop(self._stop_order())
        self._traffic = Traffic(self._links, _LOGGER)
        self._diagnostics = Diagnostics(self._links, _LOGGER)
        log = SparingLog('announcements', _LOGGER)
        self._announcements = LatestWorker('announcements', _ANNOUNCEMENT_PAUSE,
                                           partial(log_fault, log))
        custom_names = {name: key for board in p['boards']
                        for name, key in board.custom_names(parameters.of_board(board, p))}
        announced = [each.announced for each in self._interfaces if each.announced]
        for rows in announced:
            rows.serve(self._announcements, custom_names, given, log, announced)
        self._settings_worker = LatestWorker('settings', SETTINGS_PAUSE, partial(log_fault, log))
        serve_settings(self._links, given, self._settings_worker, SparingLog('settings', _LOGGER))

    def start(self) -> None:
        """Open the ports, subscribe to commands and offer services."""
        # Not only the heartbeat's thread gets it: while any thread holds the interpreter's lock
        # and waits for the processor, the heartbeat waits, too.
        set_priority_of_all(_PRIORITY)
        for interface in self._interfaces:
            with _errors_naming(type(interface)):
                interface.link.start()
        self.stop_service.advertise()
        for interface in self._interfaces:
            with _errors_naming(type(interface)):
                interface.advertise()
                _offer_lending(interface.link)
        self._announcements.start()
        self._settings_worker.start()
        self._diagnostics.start()

    def _stop_order(self) -> List[Link]:
        return sorted(self._links, key=lambda link: not link.STOPS_FIRST)

    def stop(self) -> None:
        """Send SPEED 0 first, then stop everything; takes 1 s at most, even if a port hangs."""
        for link in self._stop_order():
            link.stop()
        deadline = time.monotonic() + _SHUTDOWN
        for link in self._links:
            link.join(max(0.0, deadline - time.monotonic()))
        self._diagnostics.stop()
        # After its socket is closed, rospy's server thread runs in a busy loop. With real-time
        # priority it would keep the processor from the threads that it waits for. Also, a process
        # that replaces this one (execve) would inherit the priority.
        set_priority_of_all(0)
