"""The live table as a program: what the monitor and the demo share."""
import logging
import signal
import threading
import time
from typing import Callable, Optional, Tuple

import rospy

from .state import BridgeState, ago
from .table import PERIOD, Heading, Screen, TextLine
from .watcher import Watcher


def stopped_by_signals() -> threading.Event:
    """Return an event that SIGINT, SIGTERM and SIGHUP set."""
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    return stopping


class LiveTable:
    """Shows a bridge once a second, and reports when it disappears and when it returns.

    Args:
        name: this process becomes a ROS node of this name.
        heading: returns what is shown around the links and topics, given the seconds since the
            start and some notes.
    """

    def __init__(self, name: str, bridge: BridgeState,
                 heading: Callable[[float, Tuple[TextLine, ...]], Heading]) -> None:
        self.elapsed = 0.0     # s
        self._bridge = bridge
        self._heading = heading
        self._outages = Outages()
        self._screen = Screen()
        logging.raiseExceptions = False     # or tracebacks cover the table if the disk is full
        rospy.init_node(name, anonymous=True, disable_signals=True)
        self.watcher = Watcher(bridge)
        self.watcher.start()

    def run(self, stopping: threading.Event, duration: Optional[float] = None) -> None:
        """Show the table until `stopping` is set, or for `duration` seconds."""
        began = due = time.monotonic()
        while not stopping.is_set():
            now = time.monotonic()
            self.elapsed = now - began
            self.watcher.update(now)
            event = self._outages.update(self._bridge.trouble(now), self._bridge.reported_at(), now)
            if event:
                self._screen.say(f'{time.strftime("%H:%M:%S")} {event}')
            self._screen.draw(self._bridge, self._heading(self.elapsed, self._outages.notes()),
                              now)
            if duration and self.elapsed >= duration:
                return
            due = max(due + PERIOD, now)
            if duration:
                due = min(due, began + duration)
            stopping.wait(max(0.0, due - time.monotonic()))

    def close(self) -> None:
        """Leave the last table on the screen and restore the terminal."""
        self._screen.close(self._bridge, self._heading(self.elapsed, ()), time.monotonic())


class Outages:
    """Reports when a bridge disappears and when it returns."""

    def __init__(self) -> None:
        self._trouble = ''
        self._last_report: Optional[float] = None    # of the bridge, before the trouble
        self._last_return = ''

    def update(self, trouble: str, reported_at: Optional[float], now: float) -> str:
        """Return what has happened since the last call, in words; '' if nothing has.

        Args:
            trouble: why nothing new can be received; '' while the bridge reports.
            reported_at: the time of its latest report on a link.
        """
        had_trouble, self._trouble = self._trouble, trouble
        if trouble:
            return '' if had_trouble else trouble
        before, self._last_report = self._last_report, reported_at
        if before is None:
            return 'the bridge is there'
        if not had_trouble:
            return ''
        event = f'the bridge is back, after {ago(now - before)}'
        self._last_return = f'{time.strftime("%H:%M:%S")} {event}'
        return event

    def notes(self) -> Tuple[TextLine, ...]:
        """The latest return of the bridge, for a user who was not watching."""
        shows = self._last_return and not self._trouble
        return (TextLine(self._last_return, 'warn'),) if shows else ()
