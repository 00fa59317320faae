"""What the statistical part checks: the motor, the calls, the values and the process.

Lateness is judged later, in the storm's own thread: waiting for the witness would delay the thread
that reads the line.
"""
import contextlib
import itertools
import struct
import threading
import time
from collections import Counter, defaultdict, deque
from typing import Any, Callable, Deque, Dict, Iterator, List, NamedTuple, Optional, Tuple

from processes import usage_of
import by_definition as codec
from .boards import ANNOUNCE, DEPTH, HEIGHT, MEMORY, Key, Packet, Request
from .exact_bus import Key as RequestKey
from .rig import POLLED_TOPICS, SPEED_TIMEOUT, Rig
from .robot import Outcome, Published

_AGE, _NETWORK_AGE = 0.7, 1.5    # s; no older speed reaches the board
_STOP_TIME = SPEED_TIMEOUT + 0.05      # s
_CALL_TIME = 6.0         # s: for its turn, three tries, and two stalls
_KEPT = 10.0             # s after which a value that was not published is lost
_BEFORE, _AFTER = 0.3, 3.0       # s beside a disturbance in which values may be lost
_STALL = 0.2             # s by which a witness has to be late to excuse a lost value
# Growth at most, in a run of any length and in each hour.
_GROWTH = {'memory': (1.0, 2.0, 'MB'), 'threads': (3.0, 1.0, ''), 'files': (5.0, 1.0, '')}
_SETTLING = 60.0         # s, or a third of a shorter part
_POLLS = (DEPTH, b''), (HEIGHT, b''), (codec.ENVIRONMENT, b''), (ANNOUNCE, b'\0')


class MotorCheck:
    """Checks what the car receives."""

    def __init__(self, rig: Rig) -> None:
        self._rig, self._oldest = rig, _NETWORK_AGE if rig.is_network else _AGE
        self._commanded = rig.row('every SPEED was commanded, and is sent once')
        self._fresh = rig.row('no SPEED over 0.7 s after its command, 1.5 s behind socket://')
        self._stopped = rig.row('SPEED 0 within speed_timeout + 50 ms of the last command')
        self._first = rig.row('SPEED 0 is the first packet whenever the port opens')
        self._commands: Dict[int, float] = {}        # when each was published
        self._is_first = True
        self._speed_at: Optional[float] = None       # of the last speed other than 0
        self._late: Deque[Tuple] = deque()
        self._lock = threading.RLock()

    def command(self, value: int) -> None:
        with self._lock:
            self._commands[value] = time.monotonic()
        self._rig.robot.command('speed', value, time.time())

    def start_connection(self) -> None:
        with self._lock:
            self._is_first, self._speed_at = True, None

    def resumed(self) -> None:
        """The bridge or its network continues; it may stop from now on."""
        with self._lock:
            self._speed_at = self._speed_at and time.monotonic()

    def received(self, packet: Packet) -> None:
        with self._lock:
            if self._is_first:
                self._first.check(packet.is_stop and not packet.beats, f'the first was {packet}')
                self._is_first = False
            if packet.type != codec.SPEED:
                return
            self.check_stop(packet.t)
            self._speed_at = packet.t if packet.number else None
            if not packet.number:
                return
            at, text = self._commands.pop(packet.number, None), f'SPEED {packet.number}'
            if self._commanded.check(at, text):
                self._in_time(self._fresh, at, packet.t, self._oldest, text)

    def check_stop(self, now: float) -> None:
        """To be called for each heartbeat, too."""
        with self._lock:
            if self._speed_at is not None:
                if not self._in_time(self._stopped, self._speed_at, now, _STOP_TIME, 'no stop'):
                    self._speed_at = None       # one violation is enough

    def _in_time(self, *check: Any) -> bool:
        """`Rig.in_time`; if it is late, at the next `judge`."""
        required, since, until, limit, _text = check
        if until - since > limit:
            self._late.append(check)
            return False
        required.keep_worst((until - since) * 1e3, 'ms')
        required.checks += 1
        return True

    def judge(self) -> None:
        while self._late:
            self._rig.in_time(*self._late.popleft())


class CallCheck:
    """Compares what calls returned with what the board received and did."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        refused = rig.row('outcome refused or not sent: not executed')
        self._outcomes = {
            'done': rig.row('outcome done: executed exactly once'),
            'not known': rig.row('outcome not known: executed at most once'),
            'refused': refused, 'not sent': refused}
        self._own_data = rig.row('a raw call returns the data of its own reply')
        self._returned = rig.row('every call returns within 6 s')
        self._belongs = rig.row('every request belongs to a call that waits, or to a poll')
        self._once = rig.row('a request comes again only after INVALID')
        self.executed: 'Counter[RequestKey]' = Counter()
        self._numbers = itertools.count(1)
        self._expected: Dict[RequestKey, int] = {}      # how often each may still be received
        self._lock = threading.RLock()

    def call(self) -> None:
        """Make one call."""
        key, began = (MEMORY, struct.pack('<I', next(self._numbers))), time.monotonic()
        with self._lock:
            self._expected[key] = 1
        outcome = self._rig.robot.call('bus/request', codec.FUNCTION, *key)
        with self._lock:
            del self._expected[key]
        self._rig.in_time(self._returned, began, time.monotonic(), _CALL_TIME, f'{key}')
        self.check(key, outcome)

    def received(self, request: Request) -> None:
        """To be called for each request that the board receives."""
        key = request.key
        if request.cmd1 in (codec.SYNC, codec.ECHO):
            return
        with self._lock:
            self._belongs.check(key in self._expected or key in _POLLS, f'{request}')
            if key in self._expected:
                self._once.check(self._expected[key] > 0, f'{request}')
                self._expected[key] -= 1

    def invalid(self, key: RequestKey) -> None:
        """The board replies that it has not executed this request."""
        with self._lock:
            if key in self._expected:
                self._expected[key] += 1

    def check(self, key: RequestKey, outcome: Outcome) -> None:
        executed = self.executed.pop(key, 0)
        text = f'{key[1].hex()}: {outcome}, executed {executed} times'
        if self._returned.check(outcome.status is not None, text):
            self._outcomes[outcome.name].check(outcome.is_true(executed), text)
        if outcome.success:
            self._own_data.check(outcome.data == key[1], text)


class Value(NamedTuple):
    """A value that a board sent."""

    key: Any
    at: float
    must: bool           # whether it has to be published


class ValueCheck:
    """Compares what was published with what was sent in valid frames: in order, and once.

    A value may be lost only in a disturbance, or after it until the next one is published.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._correct = rig.row('every published value was in a valid frame, in order, once')
        self._lost = rig.row('values are lost only in a stall or reconnect, until the next one')
        self._waiting: Dict[str, Deque[Value]] = defaultdict(deque)     # by topic
        self._latest: Dict[str, float] = defaultdict(float)     # when the last published was sent
        self._skipped: List[Tuple[str, Value, float]] = []      # with `_latest` of that time
        self._disturbances: Deque[Disturbance] = deque(maxlen=1000)
        self._lock = threading.RLock()

    @contextlib.contextmanager
    def disturbance(self, link: str = '') -> Iterator[None]:
        """Something happens to a link, or to all, by which values may be lost."""
        disturbance = Disturbance(link, time.monotonic())
        self._disturbances.append(disturbance)
        yield
        disturbance.until = time.monotonic()

    def sent(self, keys: List[Key], must: bool) -> None:
        with self._lock:
            for topic, key in keys:     # words, as for a range, say nothing about which it is
                if not isinstance(key, str):
                    self._waiting[topic].append(
                        Value(key, time.monotonic(), must and topic not in POLLED_TOPICS))

    def published(self, topic: str, message: Published) -> None:
        if message.key is None or isinstance(message.key, str):
            return
        with self._lock:
            waiting = self._waiting[topic]
            keys = [each.key for each in waiting]
            if not self._correct.check(message.key in keys, f'{topic} {message.key}'):
                return
            for _ in range(keys.index(message.key)):
                self._skip(topic)
            value = waiting.popleft()
            self._latest[topic] = value.at
            self._lost.checks += value.must

    def _skip(self, topic: str) -> None:
        value = self._waiting[topic].popleft()
        if value.must:
            self._skipped.append((topic, value, self._latest[topic]))

    def judge(self) -> None:
        """Decide about the values that were not published."""
        until = time.monotonic() - _KEPT
        with self._lock:
            for topic, waiting in self._waiting.items():
                while waiting and waiting[0].at < until:
                    self._skip(topic)
            skipped, self._skipped = self._skipped, []
        for topic, value, latest in skipped:
            link = 'mcu' if 'mcu' in topic else 'arduino'
            if any(each.excuses(link, value.at, latest) for each in self._disturbances):
                continue
            if self._rig.excuses(value.at - _BEFORE, value.at + _BEFORE, _STALL):
                self._lost.undecided += 1
            else:
                self._lost.check(False, f'{topic} {value.key}, sent at {value.at:.3f}')


class Disturbance:
    """A time in which values of a link, or of all links, may be lost."""

    def __init__(self, link: str, since: float) -> None:
        self.link, self.since, self.until = link, since, float('inf')

    def excuses(self, link: str, at: float, latest: float) -> bool:
        """Whether a value may be lost; `latest` was sent before it, and published."""
        return self.link in ('', link) and latest < self.until and \
            self.since - _BEFORE < at < self.until + _AFTER


class GrowthCheck:
    """Compares the bridge's memory, threads and files in the two halves of a storm."""

    def __init__(self, rig: Rig, duration: float) -> None:
        self._rig = rig
        self._began = time.monotonic() + min(_SETTLING, duration / 3)
        self._half = (time.monotonic() + duration - self._began) / 2
        self._most = [dict.fromkeys(_GROWTH, 0.0), dict.fromkeys(_GROWTH, 0.0)]

    def judge(self) -> None:
        """To be called every few seconds."""
        seconds = time.monotonic() - self._began
        if seconds < 0:
            return
        half = int(seconds > self._half)
        for name, value in usage_of(self._rig.child_bridge.pid).items():
            self._most[half][name] = max(self._most[half][name], value)
            if half:
                noise, per_hour, unit = _GROWTH[name]
                first, second = (most[name] for most in self._most)
                self._rig.row(f'no growth: {name}').at_most(
                    second - first, noise + per_hour * self._half / 3600, unit, f'from {first:.1f}')
