"""Polls: functions that the link calls by itself, each with its period."""
import math
from typing import Callable, List, Optional

from ...link.outcome import Outcome
from ...transport.pace import Every
from . import wire
from .call import Call

OnSuccess = Callable[[Outcome], None]


class Poller:
    """Calls a function every `period` s, unless the call before has no outcome yet."""

    def __init__(self, period: float, submit: Callable[[], Call],
                 announced: bool = False) -> None:
        self.announced = announced      # it waits until the board has announced the function
        self.pace = Every(period, 0.0)
        self._period = period
        self._submit = submit
        self._latest: Optional[Call] = None

    def start(self, now: float) -> None:
        """Begin the periods now; the first call is due at once."""
        self.pace = Every(self._period, now - self._period)

    def tick(self, now: float) -> None:
        """Submit a call if it is due; missed periods are skipped."""
        if self.pace.passed(now) and (
                self._latest is None or self._latest.outcome is not None):
            self._latest = self._submit()


class Polls:
    """All polls of a link.

    Args:
        submit: submits a poll: request, function, and what gets a successful outcome.
    """

    def __init__(self, submit: Callable[[wire.Request, wire.Function, OnSuccess], Call]) -> None:
        self._submit = submit
        self._pollers: List[Poller] = []

    def add(self, function: wire.Function, period: float, on_success: OnSuccess) -> Poller:
        """Call a function, with zeros as its values, every `period` s until `remove`.

        Args:
            on_success: called in the link's thread with each successful outcome.
        """
        request = function.make_request((0,) * len(function.request.values))
        poller = Poller(period, lambda: self._submit(request, function, on_success),
                        function.announced)
        self._pollers = [*self._pollers, poller]     # the link's thread may be reading the old list
        return poller

    def remove(self, poller: Poller) -> None:
        """Submit no further calls; `on_success` may be called once more."""
        self._pollers = [each for each in self._pollers if each is not poller]

    def start(self, now: float) -> None:
        """The port was opened: all are due at once."""
        for poller in self._pollers:
            poller.start(now)

    def tick(self, now: float, is_announced: bool) -> float:
        """Submit what is due; return when the next one is."""
        due = math.inf
        for poller in self._pollers:
            if is_announced or not poller.announced:
                poller.tick(now)
                due = min(due, poller.pace.due)
        return due
