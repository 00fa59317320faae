"""What the storm checks: the motor, the calls, the values and the process.

Times are judged later, in the storm's own thread: to wait for the witness would delay the thread
that reads the line.
"""
import contextlib
import itertools
import math
import struct
import threading
import time
from collections import Counter, defaultdict, deque
from statistics import median
from typing import Any, Deque, Dict, Iterator, List, NamedTuple, Tuple

from bench.processes import usage_of
import by_definition as codec
from .boards import ANNOUNCE, DEPTH, HEIGHT, MEMORY, Fence, Key, Packet, Request
from .rig import FENCED, POLLED_TOPICS, SPEED_TIMEOUT, Rig
from .robot import Outcome

_AGE, _NETWORK_AGE = 0.7, 1.5    # s; no older speed reaches the board
_STOP_TIME = SPEED_TIMEOUT + 0.05      # s
_ECHOES = 2.0            # s that three ECHOs, a SYNC and a silence take at most
_CALL_TIME = 6.0         # s: for its turn, three tries, and two stalls
_KEPT = 10.0             # s after which a value that was not published is lost
_RETURN = 1.0            # s until values are published again after a stall
_BEFORE, _AFTER = 0.3, 3.0       # s beside a disturbance in which values may be lost
# Growth at most, in a run of any length and in each hour.
_GROWTH = {'memory': (1.0, 2.0, 'MB'), 'threads': (3.0, 1.0, ''), 'files': (10.0, 1.0, '')}
_SETTLING = 300.0        # s until malloc's arenas are filled, or a third of a shorter part
_POLLS = (DEPTH, b''), (HEIGHT, b''), (codec.ENVIRONMENT, b''), (ANNOUNCE, b'\0')


class MotorCheck:
    """Checks what the car receives."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._commands: Dict[int, float] = {}        # when each was published
        self._is_first = False                       # whether the next packet is of a connection
        self._speed_at = math.inf                # of the last speed, unless it was 0
        self._times: Deque[Tuple] = deque()          # to be judged

    def command(self, value: int) -> None:
        self._commands[value] = time.monotonic()
        self._rig.robot.drive(value)

    def start_connection(self) -> None:
        self._is_first, self._speed_at = True, math.inf

    def resumed(self) -> None:
        """The bridge or its network continues; it may stop from now on."""
        self._speed_at = max(self._speed_at, time.monotonic())

    def received(self, packet: Packet) -> None:
        row, text = self._rig.row, f'SPEED {packet.number}'
        if self._is_first:
            row('SPEED 0 is the first packet whenever the port opens').check(
                packet.is_stop and not packet.beats, f'the first was {packet}')
            self._is_first = False
        if packet.type != codec.SPEED:
            return
        self._drove_until(packet.t)
        if packet.number:
            self._speed_at = packet.t
            at = self._commands.pop(packet.number, None)
            if row('every SPEED was commanded, and is sent once').check(at, text):
                self._times.append((
                    row('no SPEED over 0.7 s after its command, 1.5 s behind socket://'),
                    at, packet.t, _NETWORK_AGE if self._rig.is_network else _AGE, text))

    def heartbeat(self, now: float) -> None:
        if now > self._speed_at + _STOP_TIME:
            self._drove_until(now)

    def _drove_until(self, now: float) -> None:
        if self._speed_at <= now:
            self._times.append((
                self._rig.row('SPEED 0 within speed_timeout + 50 ms of the last command'),
                self._speed_at, now, _STOP_TIME, 'no stop'))
        self._speed_at = math.inf

    def judge(self) -> None:
        while self._times:
            self._rig.in_time(*self._times.popleft())


class CallCheck:
    """Compares what calls returned with what the board received and did."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._returned = rig.row('every call returns within 6 s')
        self.executed: 'Counter[Tuple[int, bytes]]' = Counter()
        # By request: how often the board may still receive it.
        self._expected: Dict[Tuple[int, bytes], int] = {}
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self.fences: Deque[Fence] = deque()      # to be judged

    def call(self) -> None:
        """Make one call."""
        key, began = (MEMORY, struct.pack('<I', next(self._numbers))), time.monotonic()
        with self._lock:
            self._expected[key] = 1
        outcome = self._rig.robot.request(codec.FUNCTION, *key)
        with self._lock:
            del self._expected[key]
        self._rig.in_time(self._returned, began, time.monotonic(), _CALL_TIME, f'{key}')
        self.check(key, outcome)

    def check(self, key: Tuple[int, bytes], outcome: Outcome) -> None:
        executed = self.executed.pop(key, 0)
        text = f'{key[1].hex()}: {outcome}, executed {executed} times'
        if self._returned.check(outcome.status is not None, text):
            outcome.check(self._rig.row, executed, text)
        if outcome.success:
            self._rig.row('a raw call returns the data of its own reply').check(
                outcome.data == key[1], text)

    def received(self, request: Request) -> None:
        """To be called for each request that the board receives."""
        if request.cmd1 in (codec.SYNC, codec.ECHO):
            return
        key, row = request.key, self._rig.row
        with self._lock:
            row('every request belongs to a call that waits, or to a poll').check(
                key in self._expected or key in _POLLS, f'{request}')
            if key in self._expected:
                row('a request comes again only after INVALID').check(
                    self._expected[key] > 0, f'{request}')
                self._expected[key] -= 1

    def judge(self) -> None:
        """Decide about the fences: an ECHO that the machine delays is lost for the bridge."""
        required = self._rig.row(FENCED)
        while self.fences:
            fence = self.fences.popleft()
            if not fence.holds and self._rig.machine.stalled(fence.t - _ECHOES, fence.t):
                required.undecided += 1
            else:
                required.check(fence.holds, fence.text)

    def invalid(self, key: Tuple[int, bytes]) -> None:
        """The board has not executed this request, and replies so: it may receive it again."""
        with self._lock:
            if key in self._expected:
                self._expected[key] += 1


class Value(NamedTuple):
    """A value that a board sent."""

    key: Any
    at: float
    must: bool           # whether it has to be published


class Disturbance:
    """A time in which values of a link, or of all links, may be lost."""

    def __init__(self, link: str) -> None:
        self.link, self.since, self.until = link, time.monotonic(), math.inf

    def excuses(self, link: str, at: float, latest: float) -> bool:
        """Whether a value may be lost; `latest` was sent before it, and published."""
        return self.link in ('', link) and latest < self.until and \
            self.since - _BEFORE < at < self.until + _AFTER


class ValueCheck:
    """Compares what was published with what was sent in valid frames: in order, and once.

    A value may be lost only in a disturbance, or after it until the next one is published.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._lost = rig.row('values are lost only in a stall or reconnect, until the next one')
        self._waiting: Dict[str, Deque[Value]] = defaultdict(deque)     # by topic
        self._latest: Dict[str, float] = defaultdict(float)     # when the last published was sent
        self._skipped: List[Tuple[str, Value, float]] = []      # with `_latest` of that time
        self.disturbances: Deque[Disturbance] = deque(maxlen=1000)
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def disturbance(self, link: str = '') -> Iterator[None]:
        """Something happens to a link, or to all, by which values may be lost."""
        disturbance = Disturbance(link)
        self.disturbances.append(disturbance)
        yield
        disturbance.until = time.monotonic()

    def sent(self, keys: List[Key], must: bool) -> None:
        with self._lock:
            for topic, key in keys:
                if not isinstance(key, str):     # a word, as for a range, does not say which it is
                    self._waiting[topic].append(
                        Value(key, time.monotonic(), must and topic not in POLLED_TOPICS))

    def published(self, topic: str, key: Any) -> None:
        if key is None or isinstance(key, str):
            return
        with self._lock:
            keys = [each.key for each in self._waiting[topic]]
            is_known = key in keys
            if not is_known and topic in POLLED_TOPICS and topic not in self._latest:
                return      # it was sent before the storm began, since a poll never pauses
            if self._rig.row('every published value was in a valid frame, in order, once').check(
                    is_known, f'{topic} {key}'):
                self._skip(topic, keys.index(key))
                value = self._waiting[topic].popleft()
                self._latest[topic] = value.at
                self._lost.checks += value.must

    def _skip(self, topic: str, number: int) -> None:
        """So many values were not published."""
        values = [self._waiting[topic].popleft() for _ in range(number)]
        self._skipped += [(topic, each, self._latest[topic]) for each in values if each.must]

    def judge(self) -> None:
        """Decide about the values that were not published."""
        until = time.monotonic() - _KEPT
        with self._lock:
            for topic, waiting in self._waiting.items():
                self._skip(topic, sum(each.at < until for each in waiting))
            skipped, self._skipped = self._skipped, []
        for topic, value, latest in skipped:
            link = 'mcu' if 'mcu' in topic else 'arduino'
            if any(each.excuses(link, value.at, latest) for each in list(self.disturbances)):
                continue
            if self._rig.machine.stalled(value.at - _RETURN, value.at + _BEFORE):
                self._lost.undecided += 1
            else:
                self._lost.check(False, f'{topic} {value.key}, sent at {value.at:.3f}')


class GrowthCheck:
    """Compares the memory, threads and files of the bridge in the two halves of a storm.

    They are those at the median, since each port that is closed at the moment has six files less.
    """

    def __init__(self, rig: Rig, duration: float) -> None:
        settling = min(_SETTLING, duration / 3)
        self._rig, self._half = rig, (duration - settling) / 2
        self._began = time.monotonic() + settling
        self._measured: Dict[str, List[List[float]]] = {name: [[], []] for name in _GROWTH}

    def measure(self) -> None:
        """To be called often: files are open for a moment in each call of a service."""
        halves = (time.monotonic() - self._began) / self._half
        for name, value in usage_of(self._rig.child_bridge.pid).items() if halves > 0 else ():
            self._measured[name][halves > 1].append(value)
            self._rig.row(f'no growth: {name}').checks += halves > 1

    def judge(self) -> None:
        for name, halves in self._measured.items():
            noise, per_hour, unit = _GROWTH[name]
            first, second = (median(values or [math.nan]) for values in halves)
            self._rig.row(f'no growth: {name}').at_most(
                second - first, noise + per_hour * self._half / 3600, unit, f'from {first:.1f}')
