"""Polls: functions that the link calls by itself, each with its period."""
import math
from dataclasses import dataclass
from typing import Callable, List, Optional

from ...transport.pace import Every
from . import wire
from .call import Call, OnSuccess


@dataclass(eq=False)
class Poller:
    """One of them."""

    function: wire.Function
    period: float
    on_success: OnSuccess
    pace: Every     # missed periods are skipped
    latest: Optional[Call] = None


class Polls:
    """All polls of a link. A poll is not submitted while the one before it is outstanding."""

    def __init__(self, submit: Callable[[wire.Request, wire.Function, float, OnSuccess],
                                        Call]) -> None:
        self._submit = submit
        self._pollers: List[Poller] = []

    def add(self, function: wire.Function, period: float, on_success: OnSuccess) -> Poller:
        """Call a function, with zeros as its values, every `period` s until `remove`."""
        poller = Poller(function, period, on_success, Every(period, 0.0))
        self._pollers = [*self._pollers, poller]     # the link's thread may be reading the old list
        return poller

    def remove(self, poller: Poller) -> None:
        """Submit no further calls; `on_success` may be called once more."""
        self._pollers = [each for each in self._pollers if each is not poller]

    def start(self, now: float) -> None:
        """The port was opened: all are due at once."""
        for poller in self._pollers:
            poller.pace = Every(poller.period, now - poller.period)

    def tick(self, now: float, is_announced: bool) -> float:
        """Submit what is due, or only what no board announces; return when the next one is."""
        due = math.inf
        for poller in self._pollers:
            if poller.function.announced and not is_announced:
                continue
            if poller.pace.passed(now) and (poller.latest is None or poller.latest.outcome):
                function = poller.function
                zeros = (0,) * len(function.layout.values)
                poller.latest = self._submit(function.make_request(zeros), function, now,
                                             poller.on_success)
            due = min(due, poller.pace.due)
        return due
