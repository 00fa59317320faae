"""A world in virtual time: nothing in it waits, and a seed repeats all of it.

Its time moves from one event to the next. There is no thread and no sleep, so a run does not depend
on the machine. Whatever is drawn by chance comes from generators that the seed begins.
"""
import heapq
from random import Random
from typing import Callable, List, Optional

_LATENCY = 2e-4     # s; until a loop of the bridge runs, at most, on an idle computer


class World:
    """Events in order of time; events of the same time in an order that the seed decides."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)
        self.time = 1000.0              # s; of the boards, the lines and the scenario
        self.suspensions: List[tuple] = []      # (begin, end) of times in which no loop ran
        self._ties = Random(f'ties {seed}')
        self._frozen_until = 0.0        # the bridge does not run until then
        self._count = 0
        self._events: list = []

    def clock(self) -> float:
        """The clock of the bridge, which may be frozen inside a call while the world goes on."""
        return max(self.time, self._frozen_until)

    def freeze(self, seconds: float) -> None:
        """Let no loop of the bridge run for so long. Within a call of the bridge: the call takes so
        long, and whatever happens meanwhile happens once it has returned."""
        begin = self.clock()
        self.wait(seconds)
        self.suspensions.append((begin, self._frozen_until))

    def wait(self, seconds: float) -> None:
        """Likewise, but the bridge waits by itself."""
        self._frozen_until = self.clock() + seconds

    def at(self, time: float, action: Callable[[], None]) -> None:
        """Call `action` at this time, or now if it is past."""
        self._count += 1
        heapq.heappush(self._events, (max(time, self.time), self._ties.random(), self._count,
                                      action))

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Call `action` so many seconds from now."""
        self.at(self.time + seconds, action)

    def run(self, seconds: float) -> None:
        """Run all events of the next `seconds`."""
        end = self.time + seconds
        while self._events and self._events[0][0] <= end:
            self.time, _, _, action = heapq.heappop(self._events)
            action()
        self.time = end


class Loop:
    """A loop of the bridge: its step runs when it is due or woken, later while it is starved.

    Args:
        step: returns when to be called next, by the world's clock.
    """

    def __init__(self, world: World, step: Callable[[], float]) -> None:
        self.stalls: List[tuple] = []       # (begin, end) of times in which it did not run
        self._world = world
        self._step: Optional[Callable[[], float]] = step
        self._starved_until = 0.0
        self._due = float('inf')        # of the event that counts: the others are ignored
        self._call_at(world.time)

    def wake(self) -> None:
        """Call the step soon."""
        self._call_at(self._world.clock())

    def starve(self, seconds: float) -> None:
        """Let it not run for so long."""
        now = self._world.clock()
        self._starved_until = max(self._starved_until, now + seconds)
        self.stalls.append((now, self._starved_until))

    def end(self) -> None:
        """Call it no more."""
        self._step = None

    def _call_at(self, time: float) -> None:
        due = time + self._world.random.random() * _LATENCY
        if due < self._due:
            self._due = due
            self._world.at(due, lambda: self._run(due))

    def _run(self, due: float) -> None:
        if due != self._due or self._step is None:
            return      # an earlier call has taken its place
        self._due = float('inf')
        blocked_until = max(self._world.clock(), self._starved_until)
        if blocked_until > self._world.time:
            self._call_at(blocked_until)
        else:
            self._call_at(max(self._step(), self._world.clock()))
