"""The node: reads the parameters, puts the links together with ROS, and ends them in order."""
import logging
import os
import signal
import sys
import threading
import time

import rospy

from ..output import print_line_by_line
from ..transport.pace import all_be_quick
from ..transport.terminal import write_in_background
from . import background_logging, direct, handshake, parameters, starting
from .diagnostics import Diagnostics
from .geometry import publish_mounts
from .interface import Common
from .master_watch import MasterWatch
from .traffic import Traffic

_SWITCH_INTERVAL = 0.0005   # s that a busy thread may keep the interpreter from the heartbeat
_NAME = 'serial_communication'    # unless the command line gives another one
_PRIORITY = 1               # real-time, where the system allows it
_SHUTDOWN = 1.0             # s for the links to end in
_LAST_RESORT = 1.5          # s until the process ends, whatever keeps the interpreter alive
_LOGGER = logging.getLogger('rosout')    # rospy's own, for terminal, file and /rosout


def main() -> None:
    """Run until ROS or a signal ends it, and exit."""
    print_line_by_line()
    starting.check_arguments(sys.argv[1:])
    sys.setswitchinterval(_SWITCH_INTERVAL)
    write_in_background()
    background_logging.install()
    status = 1
    try:
        status = _run()
    finally:
        background_logging.finish(status)
    sys.exit(status)


def _run() -> int:
    ended = starting.may_start(_NAME)
    if ended is not None:
        return ended
    handshake.install(_LOGGER)
    try:
        rospy.init_node(_NAME)
    except rospy.ROSInitException:      # a signal came before the master had answered
        return 0
    direct.install(_LOGGER)
    given = rospy.get_param('~', {})
    try:
        values, warnings = parameters.check(given, rospy.get_name())
    except parameters.ParameterError as error:
        rospy.logfatal(str(error))
        starting.linger()
        return 1
    for warning in warnings:
        rospy.logwarn(warning)
    bridge = Bridge(values)
    rospy.on_shutdown(bridge.stop)
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:    # as nohup has it
        signal.signal(signal.SIGHUP, lambda *_: rospy.signal_shutdown('the terminal has gone'))
    bridge.start()
    MasterWatch(given, _LOGGER).start()
    rospy.spin()
    return 0


class Bridge:
    """The links that have a port, and what belongs to all of them."""

    def __init__(self, p: dict) -> None:
        common = Common(p['frame_timeout'], rospy.Time.now, _LOGGER)
        boards = [(board, own) for board, own in (
            (board, parameters.of_board(board, p)) for board in p['boards']) if own['port']]
        self._interfaces = [board(own, common) for board, own in boards]
        self._links = [interface.link for interface in self._interfaces]
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
        self._stopping = threading.Event()

    def start(self) -> None:
        """Open the ports and take calls."""
        # Not the heartbeat's thread alone: any other may hold the interpreter's lock while it waits
        # for the processor, and the heartbeat with it.
        all_be_quick(_PRIORITY)
        threading.Thread(target=self._last_resort, name='last resort', daemon=True).start()
        for link in self._links:
            link.start()
        for interface in self._interfaces:
            interface.advertise()
        self._diagnostics.start()

    def stop(self) -> None:
        """SPEED 0 first, then everything ends; in 1 s even where a port hangs."""
        self._stopping.set()
        for link in sorted(self._links, key=lambda link: not link.STOPS_FIRST):
            link.stop()
        deadline = time.monotonic() + _SHUTDOWN
        for link in self._links:
            link.join(max(0.0, deadline - time.monotonic()))
        self._diagnostics.stop()
        # rospy's thread for the calls of others turns in circles once its socket is closed, and
        # would keep a processor from those that it waits for.
        all_be_quick(0)

    def _last_resort(self) -> None:
        """In a thread of its own: end the process where a thread hangs, in a dead connection, say.

        It is there from the start: where no memory is left, starting one may never return.
        """
        self._stopping.wait()
        time.sleep(_LAST_RESORT)
        os._exit(0)
