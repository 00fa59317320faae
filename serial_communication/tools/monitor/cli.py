"""rosrun serial_communication monitor: the live table of a running bridge. It sends nothing.

Shows links, rates, last values and their ages, for any bridge under this ROS master: each second on
a terminal, elsewhere each five seconds. With --once it prints one table, for scripts; the status is
0 only if the bridge runs and every link is OK. --report adds what an issue needs, see report.py.
"""
import argparse
import signal
import sys
import threading
import time

import rosgraph
import rospy

from ...output import end_with_output, prepare_output
from ..watch.calls import node_argument
from ..watch.state import BridgeState
from ..watch.table import Screen, lines, plain
from ..watch.topics import NODE
from ..watch.watcher import Watcher, wait_for_master
from . import report

_PATIENCE = 5.0     # s that --once waits for the master's answer and the bridge's first report
_COLLECT = 3.0      # s that --once then counts messages: enough for topics at 1 Hz
_PERIOD, _PLAIN_PERIOD = 1.0, 5.0     # s between two tables, on a terminal and elsewhere


def main() -> int:
    """Run the monitor and return the exit status."""
    prepare_output()
    options = _arguments()
    return end_with_output(lambda: _run(options))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='monitor', description='The live table of a running bridge. It sends nothing. '
        'Ctrl-C ends it.')
    parser.add_argument('--node', type=node_argument, default=NODE, metavar='NAME',
                        help="the bridge's name (%(default)s)")
    parser.add_argument('--once', action='store_true',
                        help='print one table and end; status 0 only if every link is OK')
    parser.add_argument('--report', action='store_true',
                        help='also print versions, system, ports, diagnostics and parameters, for '
                             'an issue; without secrets and the hosts of ports')
    options = parser.parse_args(rospy.myargv()[1:])
    options.once |= options.report
    return options


def _run(options: argparse.Namespace) -> int:
    if options.report:
        print(report.of_computer(), end='\n\n', flush=True)
    bridge = BridgeState(options.node, rosgraph.get_master_uri())
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    patience = _PATIENCE if options.once else float('inf')
    if not wait_for_master(stopping, _failed, patience):
        return _failed(bridge.trouble(0.0)) if options.once else 0
    rospy.init_node('monitor', anonymous=True, disable_signals=True)
    watcher = Watcher(bridge)
    watcher.start()
    try:
        if not options.once:
            return _show(bridge, watcher, stopping)
        status = _once(bridge, watcher, stopping)
        if options.report and bridge.links:
            print(report.of_bridge(bridge))
        return status
    finally:
        rospy.signal_shutdown('it ends')


def _failed(why: str) -> int:
    print(f'monitor: {why}', file=sys.stderr)
    return 1


def _show(bridge: BridgeState, watcher: Watcher, stopping: threading.Event) -> int:
    """Show the table again and again."""
    screen = Screen() if sys.stdout.isatty() else None
    stopping.wait(_PERIOD)      # else the first table has nothing yet
    while not stopping.is_set():
        now = time.monotonic()
        watcher.update(now)
        if screen:
            screen.show(lines(bridge, now))
        else:
            print(plain(bridge, now), end='\n\n')
        stopping.wait(_PERIOD if screen else _PLAIN_PERIOD)
    return 0


def _once(bridge: BridgeState, watcher: Watcher, stopping: threading.Event) -> int:
    began = time.monotonic()
    while not stopping.wait(0.05) and bridge.reported_at() is None \
            and bridge.registered is not False and time.monotonic() < began + _PATIENCE:
        pass
    watcher.update(time.monotonic())
    if bridge.reported_at() is not None:
        stopping.wait(_COLLECT)
    now = time.monotonic()
    watcher.update(now)
    if stopping.is_set():
        return 1
    if bridge.reported_at() is None:
        return _failed(bridge.trouble(now))
    print(plain(bridge, now))
    return 0 if bridge.all_ok(now) else 1
