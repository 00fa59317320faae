"""The live table as a program: what the monitor and the demo share."""
import signal
import threading
import time
from typing import Callable, Optional, Tuple

from ...ros.rospy_mends.log_file import init_node
from .state import BridgeState, ago
from .table import PERIOD, Heading, Screen, TextLine
from .watcher import Watcher


def stopped_by_signals() -> threading.Event:
    """Is set by Ctrl-C and by every other signal that ends a program."""
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    return stopping


class LiveTable:
    """Shows a bridge once a second, and says when it goes and when it comes back.

    Args:
        name: of this process as a node, which it becomes.
        heading: what stands around it after so many seconds, with these notes.
    """

    def __init__(self, name: str, bridge: BridgeState,
                 heading: Callable[[float, Tuple[TextLine, ...]], Heading]) -> None:
        self.elapsed = 0.0     # s
        self._bridge = bridge
        self._heading = heading
        self._outages = Outages()
        self._screen = Screen()
        init_node(name, anonymous=True, disable_signals=True)
        self.watcher = Watcher(bridge)
        self.watcher.start()

    def run(self, stopping: threading.Event, duration: Optional[float] = None) -> None:
        """Until stopped, or for so many seconds."""
        began = due = time.monotonic()
        while not stopping.is_set():
            now = time.monotonic()
            self.elapsed = now - began
            self.watcher.update(now)
            event = self._outages.see(self._bridge.trouble(now), self._bridge.said_at(), now)
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
        """Leave the last table behind and give the terminal back."""
        self._screen.close(self._bridge, self._heading(self.elapsed, ()), time.monotonic())


class Outages:
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
        had_trouble, self._trouble = self._trouble, trouble
        if trouble:
            return '' if had_trouble else trouble
        before, self._last_word = self._last_word, said_at
        if before is None:
            return 'the bridge is there'
        if not had_trouble:
            return ''
        event = f'the bridge is back, after {ago(now - before)}'
        self._last_return = f'{time.strftime("%H:%M:%S")} {event}'
        return event

    def notes(self) -> Tuple[TextLine, ...]:
        """The latest return, to be seen by somebody who comes later."""
        shows = self._last_return and not self._trouble
        return (TextLine(self._last_return, 'warn'),) if shows else ()
