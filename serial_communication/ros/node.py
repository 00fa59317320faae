"""The node: checks the parameters, connects the links with ROS, and stops them in order."""
import gc
import json
import os
import signal
import sys
import time
from functools import partial
from typing import Any, Callable, Dict, Tuple

import rospy
from std_srvs.srv import SetBool, Trigger

from serial_communication.srv import Release

from ..boards import BOARDS
from ..boards.description import ANNOUNCED_GROUP
from ..framing.layout import readable
from ..framing.rows import RowError
from ..link.link import Link
from ..link.outcome import Refused
from ..link.writer import STALLED
from ..output import prepare_output
from ..transport.pace import set_priority_of_all
from . import direct, logs, parameters
from .background import LatestWorker
from .master import (NAME_TAKEN, check_arguments, empty_ports, end_within, full_name, restart,
                     running_node, watch_master)
from .publishing import publish_mounts
from .reports import Traffic, publish_diagnostics
from .settings import PARAMETER as SETTINGS
from .settings import for_xml_rpc

_SWITCH_INTERVAL = 0.0005   # s; so that a busy thread does not delay the heartbeat
_NAME = 'serial_communication'    # the default
_PRIORITY = 1               # real-time priority of all threads, if the system allows it
_SHUTDOWN = 1.0             # s for all links to end
_CLOSES = 1.5               # s for a link to close a port that is lent
_ANSWERED = 0.1             # s for the answers of calls that have ended to leave
_LAST_RESORT = 1.5          # s from a signal until the process ends, even if something hangs
# Environment of a restart, JSON: the parameters, and whether ~stop holds.
_BEFORE = 'SERIAL_COMMUNICATION_BEFORE'


def main() -> None:
    """Run until ROS or a signal ends the node, then exit."""
    prepare_output()
    check_arguments(sys.argv[1:])
    sys.setswitchinterval(_SWITCH_INTERVAL)
    name = full_name(_NAME)
    rospy.on_shutdown(partial(end_within, _LAST_RESORT, 0))
    status = 1
    try:
        status = _run(name)
    except KeyboardInterrupt:
        status = 0
    finally:
        end_within(_LAST_RESORT, status)
        logs.finish(status)
    sys.exit(status)


def _run(name: str) -> int:
    address = running_node(name)
    if address:
        print(f'{name} is already running ({address}); end that node first (rosnode kill {name}), '
              'or give this one another name (name:=NAME for the launch file, __name:=NAME for the '
              'node)', file=sys.stderr)
        return NAME_TAKEN
    try:
        rospy.init_node(_NAME)
        logs.queue_lines()
        if not direct.install():
            rospy.logwarn('this rospy sends messages differently from the versions that were '
                          'looked at: each subscriber has a thread, which costs processor time')
        if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:    # nohup ignores it
            signal.signal(signal.SIGHUP, lambda *_: rospy.signal_shutdown('the terminal is gone'))
        _start()
    except (rospy.ROSInitException, rospy.ROSInterruptException):
        if not rospy.core.is_shutdown_requested():
            raise
        return 0
    except (RowError, parameters.NameTaken) as error:
        is_name = isinstance(error, parameters.NameTaken)
        rospy.logfatal('%s', error if is_name else f'parameter {rospy.get_name()}/{error}')
        # roslaunch, which names each node's log file, would start it again, with the same mistake.
        while any(each.startswith('__log:=') for each in sys.argv) and not rospy.is_shutdown():
            time.sleep(0.1)
        return 1
    rospy.spin()
    return 0


def _start() -> None:
    given, is_stopped = json.loads(os.environ.pop(_BEFORE, '[{}, false]'))
    if given:      # a new master does not have them
        rospy.set_param('~', for_xml_rpc(given))
    for name in set(empty_ports()) & set(BOARDS):
        rospy.set_param(f'~{name}/port', '')
    given = rospy.get_param('~', {})
    for name, group in given.items():      # what the board announced in an earlier run
        if isinstance(group, dict) and group.pop(ANNOUNCED_GROUP, None) is not None:
            rospy.delete_param(f'~{name}/{ANNOUNCED_GROUP}')
    node, boards, unknown = parameters.check(given)
    for name in unknown:
        rospy.logwarn('parameter %s/%s is unknown and has no effect', rospy.get_name(),
                      readable(name))
    bridge = Bridge(node, boards, given, is_stopped)
    rospy.on_shutdown(bridge.stop)
    if rospy.core.is_shutdown_requested():      # otherwise nothing may call `stop` later
        return
    # A full garbage collection looks at all that is imported. It takes 24 ms, or more on a
    # slow computer, and holds Python's lock meanwhile, so no heartbeat is sent.
    gc.freeze()
    bridge.start()
    watch_master(bridge.start_again)


def _offer(name: str, service_class: Any, call: Callable[[Any], str]) -> None:
    """Offer a service that answers whether it is done, and what to say."""
    def handle(request: Any) -> Tuple[bool, str]:
        try:
            return True, call(request)
        except Refused as refused:
            return False, str(refused)

    rospy.Service(name, service_class, handle)


def _release(link: Link, request: Any) -> str:
    text = link.lending.lend(request.by, request.seconds)
    if request.seconds and not link.lending.closed.wait(_CLOSES):
        raise Refused('the link did not close its port in time', 'time')
    return text


class Bridge:
    """All links that have a port, with their diagnostics, transforms and serial_msg.

    Args:
        p: the checked parameters of the node; `boards`: for each board's binder its own;
            `given`: all as they were given.
        is_stopped: whether ~stop holds from the start.
    """

    def __init__(self, p: Dict[str, Any], boards: Dict[Any, Dict[str, Any]],
                 given: Dict[str, Any], is_stopped: bool) -> None:
        self._given = given
        names = parameters.resolved_names(boards)
        off = [binder.BOARD.name for binder, values in boards.items() if not values['port']]
        if off:
            (rospy.loginfo if len(off) < len(boards) else rospy.logwarn)(
                'off, because no port is set: %s (bridge.launch: if a port is given as an '
                'argument, links without a port argument are off)', ', '.join(off))
        boards = {binder: values for binder, values in boards.items() if values['port']}
        binders = [binder(values) for binder, values in boards.items()]
        self._links = sorted((binder.link for binder in binders),
                             key=lambda link: not link.session.BEATS)
        self._longest_call = max((values.get('motion_timeout', 0.0) for values in boards.values()),
                                 default=0.0)
        publish_mounts(p['base_frame_id'], {
            values[name.replace('_mount', '_frame_id')]: values[name]
            for values in boards.values() for name in values if name.endswith('_mount')})
        self._hold(is_stopped)
        Traffic(self._links)
        worker = LatestWorker('rows')
        for binder in binders:
            binder.serve(worker, names, p[SETTINGS].get(binder.BOARD.name, {}))

    def start(self) -> None:
        """Open the ports, subscribe to commands and offer services."""
        # Not only the heartbeat's thread gets it: while any thread holds the interpreter's lock
        # and waits for the processor, the heartbeat waits, too.
        set_priority_of_all(_PRIORITY)
        for link in self._links:
            link.start()
        publish_diagnostics(self._links)
        for link in self._links:
            _offer(f'~{link.name}/release', Release, partial(_release, link))
            _offer(f'~{link.name}/reset', Trigger, partial(
                lambda lending, _request: lending.reset(), link.lending))
        _offer('~stop', SetBool, self._stop_all)

    def _stop_all(self, request: Any) -> str:
        """The service ~stop."""
        if request.data:
            self._hold(True)      # all links first: from now on nothing moves again
            failures = [f'{link.name}: {failure}' for link in self._links
                        for failure in [link.stop_motion()] if failure]
            rospy.logwarn('~stop: all that moves is stopped until ~stop is called with data: '
                          + '; '.join(['false', *failures]))
            if failures:
                raise Refused('; '.join(failures), 'stop')
            return 'stopped'
        if not all(link.writer.fresh.is_fresh(link.now()) for link in self._links):
            raise Refused(STALLED, 'stall')
        if self._is_stopped:
            rospy.loginfo('~stop: released')
        self._hold(False)
        return 'released'

    def _hold(self, is_stopped: bool) -> None:
        self._is_stopped = is_stopped
        for link in self._links:
            link.session.is_stopped = is_stopped

    def stop(self) -> None:
        """Send SPEED 0 first, then stop everything; takes 1 s at most, even if a port hangs."""
        for link in self._links:
            link.stop()
        deadline = time.monotonic() + _SHUTDOWN
        for link in self._links:
            link.join(max(0.0, deadline - time.monotonic()))
        # After its socket is closed, rospy's server thread runs in a busy loop. With real-time
        # priority it would keep the processor from the threads that it waits for. Also, a process
        # that replaces this one (execve) would inherit the priority.
        set_priority_of_all(0)

    def start_again(self) -> None:
        """At a new master: let what is under way end, stop everything, and start the node again."""
        deadline = time.monotonic() + self._longest_call
        while any(link.session.under_way() for link in self._links) \
                and time.monotonic() < deadline:
            time.sleep(0.05)
        self.stop()
        time.sleep(_ANSWERED)
        settings = {link.name: link.session.board_settings for link in self._links}
        wanted = {name: each.wanted for name, each in settings.items() if each and each.wanted}
        given = {**self._given, SETTINGS: {**self._given.get(SETTINGS, {}), **wanted}}
        restart({_BEFORE: json.dumps([given, self._is_stopped], default=str)})
