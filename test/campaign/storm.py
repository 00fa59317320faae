"""The statistical part: all faults at once, and damage on every line, for any duration.

It checks only what holds for any damage, by what is on the lines:

- What the bridge writes is read before the line damages it. Times there are counted in heartbeats.
- What the bridge publishes or returns to a caller must be in the bytes that it received: in a frame
  that a board sent, or else in any valid frame at any place of those bytes.

No line freezes here, and neither order nor losses are checked. Every check is made immediately and
uses only the last seconds, so the memory that a run needs does not grow.
"""
import collections
import functools
import random
import signal
import struct
import threading
import time
from typing import Any, Callable, Deque, Dict, List, Optional, Set, Tuple

from heartbeats import BEAT_MISSED, longest_gap
from processes import usage_of
import by_definition as codec
from .boards import (DEPTH, HEIGHT, MEMORY, PERIOD, BusBoard, Car, Key, Reaction, Request, Sensors,
                     car_keys, reply_frame, reply_keys, sensor_keys)
from .exact_bus import QUEUE_TIME
from .exact_node import POLLING
from .requirements import Requirement
from .rig import MOTION_TIMEOUT, POLLED_TOPICS, REPLY_TIMEOUT, SPEED_TIMEOUT, Rig
from .robot import NOT_SENT, TIMEOUT, Outcome, Published

KEPT = 12.0              # s for which bytes and values are kept
_PUBLISH_TIME = 3.0      # s at most from a frame to its message, if a process is suspended
_CALL_TIME = 4.0         # s until a call has returned, and its late or doubled replies arrived
_COMMAND_TIME = 1.5      # s that a command may take to this process through the bridge
_DAMAGE_RATE = 0.03      # share of writes that are damaged
_MEASURE_PERIOD = 0.02   # s
_STOP_LIMIT = round((SPEED_TIMEOUT + 0.05) / PERIOD) + 1     # heartbeats until SPEED 0
_HEARTBEATS = 100        # heartbeats that are checked together …
_LATER = 400             # … and later ones, which show whether the former were only read late
_GROWTH = {'memory': (4.0, 'MB'), 'threads': (4, 'more'), 'files': (6, 'more')}     # at most
_SETTLING = 60.0         # s, or a third of a shorter part
_RECORDS = 20000         # records that are kept to be written at a violation
_RECORD_FILES = 10       # violations at which they are written


class LineHistory:
    """What the bridge received on one link in the last seconds, and the values in it."""

    def __init__(self, frame_at: codec.FrameAt, keys: Callable[[codec.Frame], List[Key]]) -> None:
        self._frame_at, self._keys = frame_at, keys
        self._writes: Deque[Tuple[float, bytes, bytes]] = collections.deque()
        self._sent: 'collections.OrderedDict[Key, float]' = collections.OrderedDict()
        self._lock = threading.Lock()

    def add(self, sent: bytes, received: bytes, now: float) -> None:
        """A board sent bytes and the bridge received them, maybe damaged; `now` is time.time()."""
        with self._lock:
            self._writes.append((now, sent, received))
            if sent == received:
                for frame in codec.decode(sent, self._frame_at)[0]:
                    for key in self._keys(frame):
                        self._sent[key] = now
                        self._sent.move_to_end(key)
            while self._writes[0][0] < now - KEPT:
                self._writes.popleft()
            while self._sent and next(iter(self._sent.values())) < now - KEPT:
                self._sent.popitem(last=False)

    def sent_at(self, key: Key) -> Optional[float]:
        """When an undamaged frame last had this value; None: not in the last seconds."""
        with self._lock:
            return self._sent.get(key)

    def has_frame(self, matches: Callable[[codec.Frame], Any], since: float, damaged: bool) -> bool:
        """Whether a valid frame at any place since then matches; if `damaged`, one not sent."""
        with self._lock:
            writes = [write for write in self._writes if write[0] >= since]
        stream, all_sent = b''.join(write[2] for write in writes), {write[1] for write in writes}
        return any(matches(frame) and not (damaged and stream[frame.start:frame.end] in all_sent)
                   for frame in codec.all_frames(stream, self._frame_at))

    def may_have(self, key: Key) -> bool:
        """Whether any recent valid frame has this value."""
        since = time.time() - _PUBLISH_TIME
        return self.has_frame(lambda frame: key in self._keys(frame), since, False)


def damage(data: bytes, rand: random.Random, may_double: bool) -> bytes:
    """Flip a bit, remove bytes or insert noise. If `may_double`, maybe repeat bytes: not on the way
    to a board, which would execute a request twice."""
    at = rand.randrange(len(data))
    noise = bytes(rand.choice((0xA5, 0x5A, 0x02, 0x03, 0x00, rand.randrange(256)))
                  for _ in range(rand.choice((1, 2, 3, 8, 20, 60))))
    return data[:at] + rand.choice((
        bytes((data[at] ^ 1 << rand.randrange(8),)) + data[at + 1:],
        data[at + rand.randrange(1, 4):], noise + data[at:], data[at:] * (1 + may_double)))


class Storm:
    """The scenario of the statistical part, with so many `busy` processes that use all CPU time."""

    def __init__(self, rig: Rig, duration: float, seed: str, busy: int) -> None:
        self.__name__ = f'all faults at once, for {duration:g} s'
        self.rig, self.duration, self._busy = rig, duration, busy
        self._random = random.Random(f'storm {seed}')
        self._stopping = threading.Event()
        self._damage_lock = threading.Lock()
        self._records: Deque[Tuple] = collections.deque(maxlen=_RECORDS)
        self._record_files = 0
        self._damaged = rig.require('storm', 'writes that were damaged, in both directions', True)
        self.from_damage = rig.require('storm', 'calls and values of frames made by damage', True)
        self.histories = {'arduino': LineHistory(codec.arduino_at, car_keys),
                          'mcu': LineHistory(codec.mcu_at, sensor_keys),
                          'bus': LineHistory(codec.reply_at, reply_keys)}
        self.motor, self.calls = MotorCheck(self), CallCheck(self)
        self._values, self._process = ValueCheck(self), ProcessCheck(self)

    def record(self, *what: Any) -> None:
        self._records.append((round(time.monotonic(), 4), *what))

    def check(self, required: Requirement, holds: Any, text: str) -> bool:
        """Check a requirement; write the latest records to a file if it is violated."""
        if required.check(holds, text):
            return True
        self.record('VIOLATED', required.text, text)
        if self._record_files < _RECORD_FILES:
            self._record_files += 1
            with open(self.rig.path(f'violation_{self._record_files}.txt'), 'w') as file:
                file.writelines(f'{record}\n' for record in list(self._records))
        return False

    def __call__(self, rig: Rig) -> None:
        rig.start(POLLING)
        self.car, self.sensors = Car(rig.car_line), Sensors(rig.mcu_line)
        self.bus = BusBoard(rig.bus_line, rig.clock)
        self.bus.readings = rig.bus.readings + 1000     # no number of the board before it
        self._connect_lines()
        traffic = rig.robot.subscribe_to_traffic(lambda message: None)
        subscriber = rig.user('subscriber', 'storm_subscriber')
        busy = rig.busy(self._busy)
        threads = [threading.Thread(target=self._guarded, args=(loop,), daemon=True) for loop in (
            self._measure, self._drive, self.calls.make_calls, self.calls.make_calls,
            lambda: self._replug('mcu', 4.0), lambda: self._replug('bus', 6.0),
            lambda: self._replug('arduino', 5.0), lambda: self._suspend_subscriber(subscriber))]
        for thread in threads:
            thread.start()
        began = time.monotonic()
        try:
            while time.monotonic() < began + self.duration:
                self._stopping.wait(self._random.uniform(2.0, 6.0))
                self._suspend_bridge()
                self._process.check((time.monotonic() - began) / self.duration)
                rig.check(rig.child_bridge)
        finally:
            self._stopping.set()
            for thread in threads:
                thread.join(5.0)
            self.calls.check_pending()
            self._disconnect_lines()
            traffic.unregister()
            for child in (subscriber, *busy):
                rig.end(child)

    def _guarded(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except Exception as error:  # pylint: disable=broad-except
            required = self.rig.require('campaign', 'every scenario runs to its end')
            self.check(required, False, f'{loop}: {type(error).__name__}: {error}')
            raise

    def wait(self, seconds: float) -> bool:
        """Wait; return whether the storm continues."""
        return not self._stopping.wait(seconds)

    def _connect_lines(self) -> None:
        """Boards without records, and lines that damage what they transfer."""
        self.bus.react, self.bus.executed = self._react, self.calls.executed
        self.car.on_packet, self.bus.on_request = (lambda packet: None), (lambda request: None)
        for link, board in (('arduino', self.car), ('bus', self.bus), ('mcu', self.sensors)):
            board.sent = board.written = collections.deque(maxlen=0)
            board.line.damage = functools.partial(self._to_bridge, link)
            board.line.on_bytes = functools.partial(self._to_board, link, board.line.on_bytes)
        self.car.line.on_unplugged = lambda: (
            self.motor.start_connection(), self.car.start_connection())
        for topic in POLLED_TOPICS:     # an earlier value cannot arrive after this one
            self.rig.wait(lambda: any(self.histories['bus'].sent_at((topic, message.key))
                                      for message in list(self.rig.robot.published[topic])),
                          f'a value of {topic}')
        self.rig.robot.on_message = self._values.check

    def _disconnect_lines(self) -> None:
        self.rig.robot.on_message = self.rig.robot.keep
        for board in (self.rig.car, self.rig.bus, self.rig.sensors):
            board.line.damage = lambda data: data
            board.attach()

    def _to_bridge(self, link: str, data: bytes) -> bytes:
        received = self._maybe_damage(data, True)
        self.histories[link].add(data, received, time.time())
        self.record(link, 'to the bridge', data.hex(), received.hex() if received != data else '')
        return received

    def _maybe_damage(self, data: bytes, may_double: bool) -> bytes:
        with self._damage_lock:
            if self._random.random() >= _DAMAGE_RATE:
                return data
            self._damaged.checks += 1
            return damage(data, self._random, may_double)

    def _to_board(self, link: str, on_bytes: Callable, data: bytes, now: float) -> None:
        if link == 'arduino':
            self.motor.read(data, now)
        received = self._maybe_damage(data, False)
        if data.strip(b'\x02\x0b\x00'):         # not only heartbeats
            self.record(link, 'to the board', data.hex(),
                        received.hex() if received != data else '')
        on_bytes(received, now)
        invalid = link == 'bus' and not codec.decode(received, codec.request_at, True)[0]
        if invalid and self._random.random() < 0.5:
            self.bus.line.write(reply_frame(codec.INVALID, bytes((codec.BAD_CHECKSUM,))))

    def _react(self, request: Request) -> Optional[Reaction]:
        if request.cmd2 in (DEPTH, HEIGHT, codec.ENVIRONMENT):
            return None
        self.calls.received(request.key)
        ok = self.bus.ok_reply(request)
        return self._random.choice((
            *[Reaction([(0, reply_frame(codec.ERROR, struct.pack('<H', codec.FAILED)))])] * 2,
            Reaction([(0, reply_frame(codec.INVALID, bytes((codec.BAD_CHECKSUM,))))]),
            Reaction([], self._random.random() < 0.5),
            Reaction([(MOTION_TIMEOUT + 0.1, ok)], True),
            *[Reaction([(0, ok), (0.005, ok)], True)] * 2,
            *[Reaction([(self._random.choice((0, 0, 0.01)), ok)], True)] * 13))

    def _measure(self) -> None:
        while self.wait(_MEASURE_PERIOD):
            self.car.measure()
            self.sensors.measure()
            self.sensors.cliff()

    def _drive(self) -> None:
        speeds = [sign * value for value in range(1, 1000) for sign in (1, -1)]
        while self.wait(0.0):
            self._random.shuffle(speeds)
            for value in speeds:
                if self._random.random() < 0.05 and not self.wait(1.0):
                    return
                self.motor.command(0 if self._random.random() < 0.05 else value)
                if not self.wait(self._random.uniform(0.02, 0.1)):
                    return

    def _replug(self, link: str, seconds: float) -> None:
        line, rand = self.rig.lines[link], random.Random(f'{link} {self._random.random()}')
        while self.wait(rand.uniform(0.5, 2 * seconds)):
            self.record(link, 'unplugged')
            line.unplug()
            self.wait(rand.uniform(0.05, 1.0))
            self.record(link, 'plugged')
            line.plug(another_name=rand.random() < 0.3)

    def _suspend_subscriber(self, subscriber: Any) -> None:
        while self.wait(self._random.uniform(0.5, 2.0)):
            subscriber.hold()
            self.wait(self._random.uniform(2.0, 6.0))
            subscriber.send(signal.SIGCONT)

    def _suspend_bridge(self) -> None:
        with self.rig.suspended():
            self.motor.clear_heartbeats()
            self.record('bridge', 'suspended')
            self.wait(self._random.choice((0.1, 0.8, 1.5)))
            self.motor.clear_heartbeats()


class MotorCheck:
    """Checks what the bridge wrote to the car, before the line damaged it."""

    def __init__(self, storm: Storm) -> None:
        require = storm.rig.require
        self._storm = storm
        self._commanded = require('storm: motor', 'every SPEED was commanded, and is sent once')
        self._age = require('storm: motor', 'no SPEED from before a reconnect')
        self._stop = require('storm: motor', 'SPEED 0 within speed_timeout + 50 ms, in heartbeats')
        self._first = require('storm: motor', 'SPEED 0 is the first packet whenever the port opens')
        self._gap = require('storm: motor', 'no gap of 30 ms between heartbeats of an open port')
        self._reader = codec.Reader(codec.arduino_at, float('inf'))
        self._commands: Dict[int, Tuple[float, int]] = {}    # time and connection (-1: none)
        self._connection, self._is_first = 0, False
        self._moving_since: Optional[int] = None     # heartbeats since the last speed other than 0
        self._times: List[float] = []                # of heartbeats
        self._lock = threading.RLock()

    def command(self, value: int) -> None:
        plugged = self._storm.rig.car_line.plugged
        with self._lock:
            if value:
                self._commands[value] = time.monotonic(), self._connection if plugged else -1
        self._storm.record('speed', value)
        self._storm.rig.robot.command('speed', value, time.time())

    def start_connection(self) -> None:
        with self._lock:
            self._reader.reset()
            self._connection += 1
            self._is_first, self._moving_since = True, None
            self._times.clear()

    def clear_heartbeats(self) -> None:
        """A gap between the previous heartbeat and the next one is no violation."""
        with self._lock:
            self._times.clear()

    def read(self, data: bytes, now: float) -> None:
        with self._lock:
            for frame in self._reader.feed(data, now):
                speed = struct.unpack('<h', frame.data)[0] if frame.type == codec.SPEED else None
                if self._is_first:
                    self._storm.check(self._first, speed == 0, f'the first was {frame.content}')
                self._is_first = False
                if frame.type == codec.HEARTBEAT:
                    self._heartbeat(now)
                elif speed:
                    self._speed(speed, now)
                if speed is not None:
                    self._moving_since = 0 if speed else None

    def _speed(self, speed: int, now: float) -> None:
        commanded, connection = self._commands.pop(speed, (0.0, 0))
        if self._storm.check(self._commanded, commanded, f'SPEED {speed} at {now:.3f}'):
            if connection != self._connection and now - commanded < _COMMAND_TIME:
                self._age.undecided += 1    # it may have reached the bridge after the reconnect
                return
            self._age.keep_worst(now - commanded, 's')
            self._storm.check(self._age, connection == self._connection,
                              f'SPEED {speed} of {now - commanded:.3f} s before')

    def _heartbeat(self, now: float) -> None:
        if self._moving_since is not None:
            self._moving_since += 1
            self._stop.keep_worst(self._moving_since * PERIOD * 1e3, 'ms')
            self._storm.check(self._stop, self._moving_since <= _STOP_LIMIT,
                              f'{self._moving_since} heartbeats since the last speed')
        self._times.append(now)
        if len(self._times) % _HEARTBEATS == 0:
            self._check_gap()

    def _check_gap(self) -> None:
        """Check the longest gap. If it may be due to a late read, later heartbeats show that."""
        gap, rig = longest_gap(self._times, 1 / PERIOD), self._storm.rig
        if gap >= BEAT_MISSED and len(self._times) < _HEARTBEATS + _LATER:
            return
        since, checks = self._times[0], len(self._times) - 1
        del self._times[:-1]
        if gap >= BEAT_MISSED and (not rig.has_priority() or rig.was_starved(gap, since)):
            self._gap.undecided += 1        # the machine may have been late, not the bridge
            return
        self._gap.checks += checks - 1
        self._gap.keep_worst(gap * 1e3, 'ms')
        self._storm.check(self._gap, gap < BEAT_MISSED, f'{gap * 1e3:.1f} ms')


class CallCheck:
    """Compares what calls returned with what the board did and what was on the line."""

    def __init__(self, storm: Storm) -> None:
        require = storm.rig.require
        self._storm = storm
        self._outcomes = {
            'done': require('storm: bus', 'outcome done: executed exactly once'),
            'refused': require('storm: bus', 'outcome refused or not sent: not executed'),
            'not known': require('storm: bus', 'outcome not known: executed at most once')}
        self._own_data = require('storm: bus', 'a raw call returns the data of its own reply')
        self._returns = require('storm: bus', 'every call returns (worst: over timeout + 0.8 s)')
        self.executed: 'collections.Counter[Tuple[int, bytes]]' = collections.Counter()
        self._numbers = iter(range(1, 1 << 32))
        self._unchecked: Set[Tuple[int, bytes]] = set()
        self._made: Deque[float] = collections.deque(maxlen=100)   # requests made by damage
        self._pending: Deque[Tuple[float, Callable[[], None]]] = collections.deque()
        self._lock = threading.RLock()

    def make_calls(self) -> None:
        while self._storm.wait(0.01):
            with self._lock:
                key = MEMORY, struct.pack('<I', next(self._numbers))
                self._unchecked.add(key)
            began = time.time()
            outcome = self._storm.rig.robot.call('bus/request', codec.FUNCTION, *key)
            self._storm.record('returned', key[1].hex(), outcome)
            self._returns.keep_worst(outcome.seconds - REPLY_TIMEOUT - QUEUE_TIME, 's')
            with self._lock:
                self._pending.append((began, functools.partial(self._check, key, outcome, began)))
                self.check_pending(time.time() - _CALL_TIME)

    def received(self, key: Tuple[int, bytes]) -> None:
        """To be called for each request that the board receives."""
        if key not in self._unchecked:
            self._made.append(time.time())

    def check_pending(self, until: float = float('inf')) -> None:
        """Check the calls that began before `until`."""
        while self._pending and self._pending[0][0] < until:
            self._pending.popleft()[1]()

    def _check(self, key: Tuple[int, bytes], outcome: Outcome, began: float) -> None:
        executed = self.executed.pop(key, 0)
        self._unchecked.discard(key)
        if not self._storm.check(self._returns, outcome.status is not None, outcome.message):
            return
        name = 'done' if outcome.success else {TIMEOUT: 'not known'}.get(outcome.status, 'refused')
        text = f'{key[1].hex()}: {outcome}, executed {executed} times'
        holds = {'done': executed == 1, 'refused': not executed, 'not known': executed <= 1}[name]
        own = not outcome.success or outcome.data == key[1]
        if not (holds and own) and self._is_from_damage(outcome, key, began):
            self._storm.from_damage.checks += 1
            return
        self._storm.check(self._outcomes[name], holds, text)
        if outcome.success:
            self._storm.check(self._own_data, own, text)

    def _is_from_damage(self, outcome: Outcome, key: Tuple[int, bytes], began: float) -> bool:
        """Whether the outcome is due to a valid frame that damage made, in either direction."""
        if outcome.status == NOT_SENT:
            return False
        made = any(began <= at <= began + outcome.seconds for at in list(self._made))
        return made or self._storm.histories['bus'].has_frame(
            lambda frame: frame.type == outcome.status and frame.data == outcome.data
            and frame.data != key[1] if outcome.success else frame.type == outcome.status, began,
            True)


class ValueCheck:
    """Compares what was published with what was on the lines."""

    def __init__(self, storm: Storm) -> None:
        self._storm = storm
        text = 'every published value was in a valid frame'
        self._checks = {link: storm.rig.require(f'storm: {link}', text) for link in storm.histories}

    def check(self, topic: str, message: Published) -> None:
        if message.key is None:
            return
        link = 'bus' if topic in POLLED_TOPICS else 'mcu' if topic.startswith('mcu/') else 'arduino'
        history, key = self._storm.histories[link], (topic, message.key)
        sent_at = history.sent_at(key)
        if sent_at is None and history.may_have(key):
            self._storm.from_damage.checks += 1
            return
        self._storm.check(self._checks[link], sent_at, f'{topic} {message.key}')


class ProcessCheck:
    """Checks the bridge's memory, threads, files and log."""

    def __init__(self, storm: Storm) -> None:
        self._rig = storm.rig
        self._most: Dict[str, List[float]] = {name: [0.0, 0.0] for name in _GROWTH}
        self._settled = min(_SETTLING / storm.duration, 1 / 3)
        self._levels = {name: storm.rig.require('storm: node', f'no growth: {name}')
                        for name in _GROWTH}

    def check(self, share: float) -> None:
        """To be called every few seconds; `share` of the duration has passed."""
        self._rig.logs.check_new_lines()
        if share < self._settled:
            return
        half = int(share > (1 + self._settled) / 2)
        for name, value in usage_of(self._rig.child_bridge.pid).items():
            most, (limit, unit) = self._most[name], _GROWTH[name]
            most[half] = max(most[half], value)
            if half:
                self._levels[name].at_most(most[1] - most[0], limit, unit,
                                           f'from {most[0]:.1f} to {most[1]:.1f}')
