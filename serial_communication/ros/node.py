"""The node: reads the parameters, puts the links together with ROS, and ends them in order."""
import logging
import os
import signal
import sys
import time
from contextlib import contextmanager
from typing import Iterator

import rospy

from ..boards import reason
from ..link.link import Link
from ..link.sparing_log import SparingLog
from ..output import prepare_output
from ..transport.pace import set_priority_of_all
from . import parameters, starting
from .diagnostics import Diagnostics
from .geometry import publish_mounts
from .interface import Common
from .last_resort import LastResort
from .parameter import ParameterError
from .rospy_mends import background_logging, direct, handshake, log_file, remapping, shortage
from .rospy_mends.master_watch import MasterWatch
from .traffic import Traffic

_SWITCH_INTERVAL = 0.0005   # s that a busy thread may keep the interpreter from the heartbeat
_NAME = 'serial_communication'    # unless the command line gives another one
_PRIORITY = 1               # real-time, where the system allows it
_SHUTDOWN = 1.0             # s for the links to end in
_LAST_RESORT = 1.5          # s from a signal until the process ends, whatever hangs
_LOGGER = logging.getLogger('rosout')    # rospy's own, for terminal, file and /rosout


def main() -> None:
    """Run until ROS or a signal ends it, and exit."""
    prepare_output()
    starting.check_arguments(sys.argv[1:])
    sys.setswitchinterval(_SWITCH_INTERVAL)
    background_logging.install()
    start = starting.Start(_NAME)
    last_resort = LastResort(_LAST_RESORT, start.end_at_last)
    status = 1
    try:
        status = _run(start, last_resort)
    finally:
        written = background_logging.finish()
        start.start_again_if_displaced()
        if not written:
            os._exit(status)
    last_resort.begin(status)
    sys.exit(status)


def _run(start: starting.Start, last_resort: LastResort) -> int:
    ended = start.may_begin()
    if ended is not None:
        return ended
    log = SparingLog('ROS', _LOGGER)
    handshake.install(log)
    shortage.install(log)
    try:
        log_file.init_node(_NAME)
    except rospy.ROSInitException:      # a signal came before the master had answered
        return 0
    finally:
        start.registered()
    direct.install(_LOGGER)
    remapping.install()
    # From here on a signal ends the process, though a module of another package, or the master,
    # hangs before there is a bridge to stop.
    rospy.on_shutdown(last_resort.begin)
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:    # as nohup has it
        signal.signal(signal.SIGHUP, lambda *_: (
            start.stopping.set(), rospy.signal_shutdown('the terminal has gone')))
    bridge = None
    try:
        given = rospy.get_param('~', {})
        values, warnings = parameters.check(given, rospy.get_name())
        for warning in warnings:
            rospy.logwarn(warning)
        bridge = Bridge(values)
        rospy.on_shutdown(bridge.stop)
        if not rospy.core.is_shutdown_requested():      # or the hook may have come too late
            bridge.start()
            MasterWatch(given, _LOGGER).start()
    except rospy.ROSInterruptException:
        return 0
    except (ParameterError, *remapping.NAME_ERRORS) as error:
        if bridge:
            bridge.stop()
        rospy.logfatal(remapping.explained(error))
        starting.linger()
        return 1
    rospy.spin()
    return 0


@contextmanager
def _code_of(board: type) -> Iterator[None]:
    """What a board's code raises as the node starts is one line, which names the board."""
    try:
        yield
    except remapping.NAME_ERRORS:
        raise       # its text is for a person
    except (Exception, SystemExit) as error:  # pylint: disable=broad-except
        named_by = '' if board in parameters.BUILT_IN else \
            f'parameter {rospy.resolve_name("~boards")}: '
        raise ParameterError(f'{named_by}the board {board.NAME} ({board.__module__}) cannot start: '
                             f'{reason(error)}') from None


class Bridge:
    """The links that have a port, and what belongs to all of them.

    Args:
        p: the parameters, checked.
    """

    def __init__(self, p: dict) -> None:
        common = Common(p['frame_timeout'], rospy.Time.now, _LOGGER)
        boards = [(board, own) for board, own in (
            (board, parameters.of_board(board, p)) for board in p['boards']) if own['port']]
        self._interfaces, self._links = [], []
        for board, own in boards:
            with _code_of(board):
                interface = board(own, common)
                if not isinstance(interface.link, Link):
                    raise TypeError(f'its link is {interface.link!r}, may be a Link')
                self._interfaces.append(interface)
                self._links.append(interface.link)
        if not self._links:
            ports = ', '.join(f'{board.NAME}/port' for board in p['boards'])
            rospy.logwarn(f'no port is set ({ports}): nothing to do')
        off = [board.NAME for board in p['boards'] if not parameters.of_board(board, p)['port']]
        if self._links and off:
            rospy.loginfo(f'off, since no port is given for it: {", ".join(off)} (bridge.launch: '
                          'where one port is named, those that are not count as empty)')
        self._mounts = publish_mounts(p['base_frame_id'], {
            own[f'{name}_frame_id']: own[f'{name}_mount']
            for board, own in boards for name in board.MOUNTS})
        self._traffic = Traffic(self._links, _LOGGER)
        self._diagnostics = Diagnostics(self._links, _LOGGER)

    def start(self) -> None:
        """Open the ports and take calls."""
        # Not the heartbeat's thread alone: any other may hold the interpreter's lock while it waits
        # for the processor, and the heartbeat with it.
        set_priority_of_all(_PRIORITY)
        for interface in self._interfaces:
            with _code_of(type(interface)):
                interface.link.start()
        for interface in self._interfaces:
            with _code_of(type(interface)):
                interface.advertise()
        self._diagnostics.start()

    def stop(self) -> None:
        """SPEED 0 first, then everything ends; in 1 s even where a port hangs."""
        for link in sorted(self._links, key=lambda link: not link.STOPS_FIRST):
            link.stop()
        deadline = time.monotonic() + _SHUTDOWN
        for link in self._links:
            link.join(max(0.0, deadline - time.monotonic()))
        self._diagnostics.stop()
        # rospy's thread for the calls of others turns in circles once its socket is closed, and
        # would keep a processor from those that it waits for. And a process that starts again in
        # the place of this one would inherit the priority.
        set_priority_of_all(0)
