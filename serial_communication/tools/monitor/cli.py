"""rosrun serial_communication monitor: the live table of a bridge that runs; it only looks.

Links, rates, last values and their ages, of any bridge under this ROS master. Once a second on a
terminal; a few lines every five seconds elsewhere. With --once one table, for scripts: the status
is 0 only if the bridge is there and every link is OK.
"""
import argparse
import signal
import sys
import threading
import time
from typing import List, Optional

import rosgraph
import rospy

from ...output import prepare_output
from ...ros.master import wait_for_master
from ...ros.rospy_mends.log_file import init_node
from ..watch.state import BridgeState, ago
from ..watch.table import PERIOD, Frame, Line, Screen, plain
from ..watch.topics import NODE
from ..watch.watcher import Watcher, leave

_PATIENCE = 5.0     # s that --once waits for a master's answer and for a bridge's first word
_COLLECT = 3.0      # s that --once then counts: what comes once a second has come by then


def main(argv: Optional[List[str]] = None) -> int:
    """Run it; returns the exit status."""
    prepare_output()
    options = _arguments(argv)
    bridge = BridgeState(options.node, master=rosgraph.get_master_uri())
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    if options.once:
        if not wait_for_master(stopping, patience=_PATIENCE):
            print(f'monitor: no answer from the ROS master at {bridge.master}', file=sys.stderr)
            return 1
    elif not wait_for_master(stopping, lambda text: print(f'monitor: {text}', flush=True)):
        return 0
    init_node('monitor', anonymous=True, disable_signals=True)
    watcher = Watcher(bridge)
    watcher.start()
    try:
        return _once(bridge, watcher, stopping) if options.once else \
            _until_stopped(bridge, watcher, stopping)
    finally:
        leave()


def _arguments(argv: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='monitor', description='The live table of a bridge that runs; it only looks. '
        'Ctrl-C ends it.')
    parser.add_argument('--node', type=_node, default=NODE, metavar='NAME',
                        help="the bridge's name (%(default)s)")
    parser.add_argument('--once', action='store_true',
                        help='print one table and end: status 0 only if every link is OK')
    return parser.parse_args((rospy.myargv() if argv is None else [''] + argv)[1:])


def _node(name: str) -> str:
    """The full name of a node; one without / stands in this shell's ROS_NAMESPACE."""
    if not rosgraph.names.is_legal_name(name) or name.startswith('~') or not name.strip('/'):
        raise argparse.ArgumentTypeError(f'{name!r} is no name of a node, such as {NODE}')
    return rosgraph.names.resolve_name(name.rstrip('/'),
                                       rosgraph.names.get_ros_namespace() + 'monitor')


def _frame(bridge: BridgeState, elapsed: float, *notes: Line) -> Frame:
    return Frame((f'Bridge {bridge.node}, {elapsed:.0f} s.', f'~ is {bridge.node}/',
                  f'Master: {bridge.master}'), notes)


def _once(bridge: BridgeState, watcher: Watcher, stopping: threading.Event) -> int:
    began = time.monotonic()
    while not stopping.wait(0.05) and bridge.said_at() is None \
            and bridge.registered is not False and time.monotonic() < began + _PATIENCE:
        pass
    if bridge.said_at() is not None:
        began = time.monotonic()
        watcher.update(began)
        stopping.wait(_COLLECT)
    now = time.monotonic()
    watcher.update(now)
    if stopping.is_set():
        return 1
    if bridge.said_at() is None:
        print(f'monitor: {bridge.trouble(now)}', file=sys.stderr)
        return 1
    print(plain(bridge, _frame(bridge, now - began), now), end='')
    return 0 if bridge.all_ok(now) else 1


def _until_stopped(bridge: BridgeState, watcher: Watcher, stopping: threading.Event) -> int:
    screen, presence = Screen(), Presence()
    began = due = time.monotonic()
    while not stopping.is_set():
        now = time.monotonic()
        watcher.update(now)
        event = presence.see(bridge.trouble(now), bridge.said_at(), now)
        if event:
            screen.say(f'{time.strftime("%H:%M:%S")} {event}')
        screen.draw(bridge, _frame(bridge, now - began, *presence.notes()), now)
        due = max(due + PERIOD, now)
        stopping.wait(max(0.0, due - time.monotonic()))
    screen.close(bridge, _frame(bridge, time.monotonic() - began), time.monotonic())
    return 0


class Presence:
    """Tells when a bridge goes and when it comes back."""

    def __init__(self) -> None:
        self._trouble = ''
        self._last_word: Optional[float] = None    # the bridge's, before the trouble
        self._last_return = ''

    def see(self, trouble: str, said_at: Optional[float], now: float) -> str:
        """What has happened since the last call, in words; mostly nothing.

        Args:
            trouble: why nothing new can come; empty while the bridge talks.
            said_at: when it said its latest word.
        """
        had_trouble, self._trouble = bool(self._trouble), trouble
        if trouble:
            return '' if had_trouble else trouble
        before, self._last_word = self._last_word, said_at
        if not had_trouble and before is not None:
            return ''
        if before is None:
            return 'the bridge is there'
        event = f'the bridge is back, after {ago(now - before)}'
        self._last_return = f'{time.strftime("%H:%M:%S")} {event}'
        return event

    def notes(self) -> List[Line]:
        """The latest return, to be seen by somebody who comes later."""
        return [Line(self._last_return, 'warn')] \
            if self._last_return and not self._trouble else []


if __name__ == '__main__':
    sys.exit(main())
