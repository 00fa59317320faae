"""rosrun serial_communication monitor: the live table of a running bridge. It sends nothing.

Shows links, rates, last values and their ages, for any bridge under this ROS master: once a second
on a terminal, elsewhere a few lines every five seconds. With --once it prints one table, for
scripts; the status is 0 only if the bridge runs and every link is OK. --report adds what an issue
needs, see report.py.
"""
import argparse
import sys
import threading
import time
from typing import List, Optional, Tuple

import rosgraph
import rospy

from ...output import end_with_output, prepare_output
from ..watch.calls import node_argument
from ..watch.live import LiveTable, stopped_by_signals
from ..watch.master import wait_for_master
from ..watch.state import BridgeState
from ..watch.table import Heading, TextLine, plain
from ..watch.topics import NODE, SERIAL_MSG
from ..watch.watcher import Watcher
from . import report

_PATIENCE = 5.0     # s that --once waits for the master's answer and the bridge's first report
_COLLECT = 3.0      # s that --once then counts messages: enough for topics at 1 Hz


def main(argv: Optional[List[str]] = None) -> int:
    """Run the monitor and return the exit status."""
    prepare_output()
    options = _arguments(argv)
    return end_with_output(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    if options.report:
        print(report.of_computer(), end='\n\n', flush=True)
    bridge = BridgeState(options.node or NODE, master=rosgraph.get_master_uri())
    stopping = stopped_by_signals()
    if options.once:
        if not wait_for_master(stopping, patience=_PATIENCE):
            print(f'monitor: no answer from the ROS master at {bridge.master}', file=sys.stderr)
            return 1
    elif not wait_for_master(stopping, lambda text: print(f'monitor: {text}', flush=True)):
        return 0
    if options.node is None:
        note = _other_bridges()
        if note:
            print(f'monitor: {note}', file=sys.stderr, flush=True)
            return 1
    table = LiveTable('monitor', bridge, lambda *args: _heading(bridge, *args))
    try:
        if options.once:
            status = _once(bridge, table.watcher, stopping)
            if options.report and bridge.links:
                print(report.of_bridge(bridge))
            return status
        table.run(stopping)
        table.close()
        return 0
    finally:
        rospy.signal_shutdown('it ends')


def _arguments(argv: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='monitor', description='The live table of a running bridge. It sends nothing. '
        'Ctrl-C ends it.')
    parser.add_argument('--node', type=node_argument, metavar='NAME',
                        help=f"the bridge's name ({NODE})")
    parser.add_argument('--once', action='store_true',
                        help='print one table and end; status 0 only if every link is OK')
    parser.add_argument('--report', action='store_true',
                        help='also print versions, system, ports, diagnostics and parameters, for '
                             'an issue; without secrets and the hosts of ports')
    options = parser.parse_args((rospy.myargv() if argv is None else [''] + argv)[1:])
    options.once |= options.report
    return options


def _other_bridges() -> str:
    """Advice that lists other bridges if the default one is absent; '' if it runs, or none does."""
    try:
        publishers = rosgraph.Master('/monitor').getSystemState()[0]
    except (OSError, rosgraph.MasterException):
        return ''
    # Every bridge offers serial_msg, in its namespace.
    found = sorted({node for topic, nodes in publishers for node in nodes
                    if topic.rpartition('/')[2] == SERIAL_MSG})
    if not found or NODE in found:
        return ''
    return f'no bridge {NODE}; these run: ' + ', '.join(f'--node {node}' for node in found)


def _heading(bridge: BridgeState, elapsed: float, notes: Tuple[TextLine, ...] = ()) -> Heading:
    return Heading((f'Bridge {bridge.node}, {elapsed:.0f} s.', f'~ is {bridge.node}/',
                    f'Master: {bridge.master}'), notes)


def _once(bridge: BridgeState, watcher: Watcher, stopping: threading.Event) -> int:
    began = time.monotonic()
    while not stopping.wait(0.05) and bridge.reported_at() is None \
            and bridge.registered is not False and time.monotonic() < began + _PATIENCE:
        pass
    if bridge.reported_at() is not None:
        began = time.monotonic()
        watcher.update(began)
        stopping.wait(_COLLECT)
    now = time.monotonic()
    watcher.update(now)
    if stopping.is_set():
        return 1
    if bridge.reported_at() is None:
        print(f'monitor: {bridge.trouble(now)}', file=sys.stderr)
        return 1
    print(plain(bridge, _heading(bridge, now - began), now), end='')
    return 0 if bridge.all_ok(now) else 1


if __name__ == '__main__':
    sys.exit(main())
