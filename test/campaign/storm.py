"""The statistical part: all faults at once, and damage on every line, for any duration.

Damage is redrawn until no valid frame that was not sent is on a line. So every comparison is exact.
Every check is made immediately and uses only the last seconds, so the memory that a run needs does
not grow.
"""
import collections
import functools
import random
import re
import signal
import struct
import threading
import time
from typing import Any, Callable, Deque, Dict, List, Optional, Tuple

from processes import usage_of
import by_definition as codec
from .boards import (ALIVE, ANNOUNCE, BLOB, COUNTER, DEPTH, HEIGHT, MEMORY, Packet, Reaction,
                     Request, reply_frame)
from .exact_bus import QUEUE_TIME
from .exact_node import POLLING
from .rig import MOTION_TIMEOUT, POLLED_TOPICS, REPLY_TIMEOUT, SPEED_TIMEOUT, Rig
from .robot import Outcome, Published

_DAMAGE_RATE = 0.03      # share of writes that are damaged
_KEPT = 15.0             # s for which a value is expected
_BESIDE = 0.3, 2.5       # s before and after a stall or a reconnect in which values may be lost
_LATE = 0.2              # s that the witness has to be late to excuse a lost value
_AGE = 0.7               # s; no older speed reaches the board
_STOP_TIME = SPEED_TIMEOUT + 0.05      # s
_MEASURE_PERIOD = 0.02   # s
# Growth at most, in a run of any length and in each hour.
_GROWTH = {'memory': (1.0, 4.0, 'MB'), 'threads': (3.0, 4.0, ''), 'files': (5.0, 6.0, '')}
_SETTLING = 60.0         # s, or a third of a shorter part
_RECORDS = 20000         # records that are kept to be written at a violation
_RECORD_FILES = 10       # violations at which they are written


class Stream:
    """What one end of a line receives: frames of the other end, of which a `share` is damaged."""

    _LONGEST = 2200      # bytes: no valid frame spans more

    def __init__(self, frame_at: codec.FrameAt, rand: random.Random, share: float) -> None:
        self._frame_at, self._random, self._share = frame_at, rand, share
        self._begins = b'\x02' if frame_at is codec.mcu_at else b'[\xA5\x5A]'
        self._received = b''
        self._writes: List[int] = []        # where each write begins
        self.damaged = 0
        self.delimited = True   # whether the latest frame has to be found

    def reset(self) -> None:
        """The line was plugged in again."""
        self._received, self._writes = b'', []

    def pass_on(self, data: bytes, may_damage: bool = True) -> bytes:
        """Return what arrives of one frame."""
        received = data
        damages = may_damage and self._random.random() < self._share
        while damages or not self._is_exact(received, received == data):
            received, damages = damage(data, self._random), False
        self.damaged += received != data
        # After a packet without its 0x00 the next one is lost, too, unless the bridge began anew.
        ended = self._received[-1:] in (b'', b'\0')
        self.delimited = ended or self._frame_at is not codec.arduino_at
        self._writes = [at for at in (*self._writes, len(self._received))
                        if at > len(self._received) - self._LONGEST]
        cut = self._writes[0]
        self._received = (self._received + received)[cut:]
        self._writes = [at - cut for at in self._writes]
        return received

    def _is_exact(self, received: bytes, is_frame: bool) -> bool:
        """Whether these bytes, behind the earlier ones, complete no valid frame but their own."""
        before = len(self._received)
        stream = self._received + received
        if self._frame_at is codec.arduino_at:      # also a packet whose beginning was given up
            starts = [*self._writes, before, *(match.end() for match in re.finditer(
                b'\0', stream) if match.end() < len(stream))]
        else:
            starts = [match.start() for match in re.finditer(self._begins, stream)]
        own = range(before, len(stream)) if is_frame else range(0)
        for at in starts:
            found = self._frame_at(stream, at)
            if isinstance(found, codec.Frame) and found.end > before and not (
                    at in own and found.end - 1 in own) and not self._is_harmless(found):
                return False
        return True

    def _is_harmless(self, frame: codec.Frame) -> bool:
        """Whether a packet of the car has an unknown type, or not the length of its type."""
        return self._frame_at is codec.arduino_at and frame.type > 3 and frame.type != BLOB \
            and len(frame.data) != {codec.STEERING_ANGLE: 2, codec.TICKS: 1, codec.IMU: 22,
                                    codec.VOLTAGE: 4, COUNTER: 4, ALIVE: 0}.get(frame.type)


def damage(data: bytes, rand: random.Random) -> bytes:
    """Flip a bit, remove bytes or insert noise."""
    at = rand.randrange(len(data))
    noise = bytes(rand.choice((0xA5, 0x5A, 0x02, 0x03, 0x00, rand.randrange(256)))
                  for _ in range(rand.choice((1, 2, 3, 8, 20, 60))))
    return data[:at] + rand.choice((
        bytes((data[at] ^ 1 << rand.randrange(8),)) + data[at + 1:],
        data[at + rand.randrange(1, 4):], noise + data[at:]))


class Storm:
    """The scenario of the statistical part, with so many `busy` processes that use all CPU time."""

    def __init__(self, rig: Rig, duration: float, seed: str, busy: int) -> None:
        self.__name__ = f'all faults at once, for {duration:g} s'
        self.rig, self.duration, self._busy = rig, duration, busy
        self._random = random.Random(f'storm {seed}')
        self._stopping = threading.Event()
        self._records: Deque[Tuple] = collections.deque(maxlen=_RECORDS)
        self._record_files = 0
        self.lock = threading.RLock()
        self.disturbed: Deque[Tuple[str, float, float]] = collections.deque(maxlen=1000)
        self._damaged = rig.row('writes that were damaged, in both directions')

        def stream(frame_at: codec.FrameAt) -> Stream:
            return Stream(frame_at, self._random, _DAMAGE_RATE)
        self._to_bridge = {'arduino': stream(codec.arduino_at), 'mcu': stream(codec.mcu_at),
                           'bus': stream(codec.reply_at)}
        self._to_bus = stream(codec.request_at)
        self.motor, self.calls, self.values = MotorCheck(self), CallCheck(self), ValueCheck(self)
        self._process = ProcessCheck(self)

    def record(self, *what: Any) -> None:
        self._records.append((round(time.monotonic(), 4), *what))

    def _on_violation(self, requirement: str, text: str) -> None:
        """Write the latest records to a file."""
        self.record('VIOLATED', requirement, text)
        if self._record_files < _RECORD_FILES:
            self._record_files += 1
            with open(self.rig.path(f'violation_{self._record_files}.txt'), 'w') as file:
                file.writelines(f'{record}\n' for record in list(self._records))

    def __call__(self, rig: Rig) -> None:
        rig.use_lines(rig.bus_line, rig.car_line)       # boards without records of before
        rig.table.on_violation = self._on_violation
        self._connect_lines()
        rig.start(POLLING)
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
                self.values.check_old()
                rig.check_always()
                rig.check(rig.child_bridge)
        finally:
            self._stopping.set()
            for thread in threads:
                thread.join(5.0)
            streams = *self._to_bridge.values(), self._to_bus
            self._damaged.checks += sum(stream.damaged for stream in streams)
            traffic.unregister()
            for child in (subscriber, *busy):
                rig.end(child)
            rig.end_bridge()
            rig.robot.on_message = rig.robot.keep
            rig.use_lines(rig.bus_line, rig.car_line)

    def _guarded(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except Exception as error:  # pylint: disable=broad-except
            self.rig.row('every scenario runs to its end').check(False, f'{loop}: {error!r}')
            raise

    def wait(self, seconds: float) -> bool:
        """Wait; return whether the storm continues."""
        return not self._stopping.wait(seconds)

    def _connect_lines(self) -> None:
        """Boards without records, and lines that damage what they transfer."""
        car, bus, sensors = self.rig.car, self.rig.bus, self.rig.sensors
        car.on_packet, car.on_beat = self.motor.received, self.motor.check_stop
        bus.on_request, bus.executed, bus.react = self.calls.received, self.calls.executed, \
            self._react
        for link, board in (('arduino', car), ('bus', bus), ('mcu', sensors)):
            board.sent = board.written = collections.deque(maxlen=0)
            board.line.damage = functools.partial(self._damage, link, board)
            board.line.on_unplugged = functools.partial(self._unplugged, link,
                                                        board.start_connection)
        bus.line.on_bytes = self._to_bus_board
        self.rig.robot.on_message = self.values.published

    def _unplugged(self, link: str, start_connection: Callable[[], None]) -> None:
        self._to_bridge[link].reset()
        if link == 'bus':
            self._to_bus.reset()
        elif link == 'arduino':
            self.motor.start_connection()
        start_connection()

    def _damage(self, link: str, board: Any, data: bytes) -> bytes:
        # Three lost ECHOs make a board one that never echoes, and silence a weaker fence.
        may_damage = link != 'bus' or self.calls.has_echoed(data)
        with self.lock:
            stream = self._to_bridge[link]
            received = stream.pass_on(data, may_damage)
            if received == data:
                self.values.sent(codec.decode(data, board.sent_frame_at)[0][0], board.keys,
                                 stream.delimited)
        self.record(link, 'to the bridge', data.hex(), received.hex() if received != data else '')
        return received

    def _to_bus_board(self, data: bytes, now: float) -> None:
        received = self._to_bus.pass_on(data, self.calls.has_echoed(b''))
        self.record('bus', 'to the board', data.hex(), received.hex() if received != data else '')
        self.rig.bus.read(received, now)
        if received != data and self._random.random() < 0.5:
            self.rig.bus.line.write(reply_frame(codec.INVALID, bytes((codec.BAD_CHECKSUM,))))
            self.calls.invalid()

    def _react(self, request: Request) -> Optional[Reaction]:
        if request.cmd2 in (DEPTH, HEIGHT, codec.ENVIRONMENT):
            return None
        ok = self.rig.bus.ok_reply(request)
        number = self._random.randrange(20)
        if number == 0:
            self.calls.invalid()
            return Reaction([(0, reply_frame(codec.INVALID, bytes((codec.BAD_CHECKSUM,))))])
        return {1: Reaction([(0, reply_frame(codec.ERROR, struct.pack('<H', codec.FAILED)))]),
                2: Reaction(), 3: Reaction([], True),
                4: Reaction([(MOTION_TIMEOUT + 0.1, ok)], True),
                5: Reaction([(0, ok), (0.005, ok)], True),
                6: Reaction([(0, ok), (0.01, ok)], True),
                7: Reaction([(0.01, ok)], True)}.get(number, Reaction([(0, ok)], True))

    def _measure(self) -> None:
        while self.wait(_MEASURE_PERIOD):
            self.rig.car.measure()
            self.rig.sensors.measure()
            self.rig.sensors.cliff()

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
            began = time.monotonic()
            self.record(link, 'unplugged')
            line.unplug()
            self.wait(rand.uniform(0.05, 1.0))
            self.record(link, 'plugged')
            line.plug(another_name=rand.random() < 0.3)
            # Until the bridge has opened it.
            self.disturbed.append((link, began, time.monotonic() + 1.5))

    def _suspend_subscriber(self, subscriber: Any) -> None:
        while self.wait(self._random.uniform(0.5, 2.0)):
            subscriber.hold()
            self.wait(self._random.uniform(2.0, 6.0))
            subscriber.send(signal.SIGCONT)

    def _suspend_bridge(self) -> None:
        began = time.monotonic()
        with self.rig.suspended():
            self.record('bridge', 'suspended')
            self.wait(self._random.choice((0.1, 0.8, 1.5)))
        self.motor.resumed()
        self.disturbed.append(('', began, time.monotonic()))


class MotorCheck:
    """Checks what the car receives."""

    def __init__(self, storm: Storm) -> None:
        row = storm.rig.row
        self._storm = storm
        self._commanded = row('every SPEED was commanded, and is sent once')
        self._age = row('no SPEED over 0.7 s after its command')
        self._stop = row('storm: SPEED 0 within speed_timeout + 50 ms')
        self._first = row('storm: SPEED 0 is the first packet whenever the port opens')
        self._commands: Dict[int, float] = {}        # when each was published
        self._is_first = True
        self._speed_at: Optional[float] = None       # of the last speed other than 0
        self._lock = threading.RLock()

    def command(self, value: int) -> None:
        with self._lock:
            self._commands[value] = time.monotonic()
        self._storm.record('speed', value)
        self._storm.rig.robot.command('speed', value, time.time())

    def start_connection(self) -> None:
        with self._lock:
            self._is_first, self._speed_at = True, None

    def resumed(self) -> None:
        """The bridge was suspended; it may stop from now on."""
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
            if packet.number:
                at = self._commands.pop(packet.number, 0.0)
                if self._commanded.check(at, f'SPEED {packet.number}'):
                    age = packet.t - at
                    self._age.keep_worst(age, 's')
                    self._age.check(age < _AGE, f'SPEED {packet.number}: {age:.3f} s')

    def check_stop(self, now: float) -> None:
        """To be called for each heartbeat, too."""
        with self._lock:
            if self._speed_at is None:
                return
            seconds, excess = now - self._speed_at, now - self._speed_at - _STOP_TIME
            if excess > 0 and self._storm.rig.excuses(self._speed_at, now - 0.06, excess):
                self._stop.undecided += 1
                return
            self._stop.keep_worst(seconds * 1e3, 'ms')
            self._stop.check(excess <= 0, f'{seconds:.3f} s')


class CallCheck:
    """Compares what calls returned with what the board received and did."""

    def __init__(self, storm: Storm) -> None:
        row = storm.rig.row
        self._storm = storm
        refused = row('storm: outcome refused or not sent: not executed')
        self._outcomes = {
            'done': row('storm: outcome done: executed exactly once'),
            'not known': row('storm: outcome not known: executed at most once'),
            'refused': refused, 'not sent': refused}
        self._own_data = row('a raw call returns the data of its own reply')
        self._returns = row('every call returns (worst: over timeout + 0.8 s)')
        self._belongs = row('every request belongs to a call that waits, or to a poll')
        self._again = row('a request comes again only after INVALID')
        self.executed: 'collections.Counter[Tuple[int, bytes]]' = collections.Counter()
        self._numbers = iter(range(1, 1 << 32))
        self._waiting: 'collections.Counter[Tuple[int, bytes]]' = collections.Counter()
        self._invalid = 0            # INVALIDs since the latest request of a call
        self._echoed_on = -1         # the connection on which an ECHO has returned
        self._lock = threading.RLock()

    def has_echoed(self, reply: bytes) -> bool:
        """Whether an ECHO has returned on this connection before this reply."""
        connection = self._storm.rig.bus.connection
        if self._echoed_on == connection:
            return True
        if reply[2:3] == bytes((codec.ECHO,)):
            self._echoed_on = connection
        return False

    def invalid(self) -> None:
        """The board sends INVALID."""
        self._invalid += 1

    def make_calls(self) -> None:
        while self._storm.wait(0.01):
            with self._lock:
                key = MEMORY, struct.pack('<I', next(self._numbers))
                self._waiting[key] = 1
            outcome = self._storm.rig.robot.call('bus/request', codec.FUNCTION, *key)
            self._storm.record('returned', key[1].hex(), outcome)
            self._returns.keep_worst(outcome.seconds - REPLY_TIMEOUT - QUEUE_TIME, 's')
            with self._lock:
                del self._waiting[key]
                self.check(key, outcome)

    def received(self, request: Request) -> None:
        """To be called for each request that the board receives."""
        if request.cmd1 in (codec.SYNC, codec.ECHO):
            return
        polled = request.key in ((DEPTH, b''), (HEIGHT, b''), (codec.ENVIRONMENT, b''),
                                 (ANNOUNCE, b'\0'))
        with self._lock:
            times = self._waiting[request.key]
            self._belongs.check(polled or times, f'{request}')
            if times:
                self._again.check(times == 1 or self._invalid, f'{request}')
                self._waiting[request.key] += 1
                self._invalid = 0

    def check(self, key: Tuple[int, bytes], outcome: Outcome) -> None:
        executed = self.executed.pop(key, 0)
        if not self._returns.check(outcome.status is not None, outcome.message):
            return
        text = f'{key[1].hex()}: {outcome}, executed {executed} times'
        self._outcomes[outcome.name].check(outcome.is_true(executed), text)
        if outcome.success:
            self._own_data.check(outcome.data == key[1], text)


class ValueCheck:
    """Compares what was published with what was sent in valid frames: in order, and once."""

    def __init__(self, storm: Storm) -> None:
        self._storm = storm
        self._sent = storm.rig.row('every published value was in a valid frame, in order, once')
        self._lost = storm.rig.row('values are lost only beside a stall or a reconnect')
        # By topic: the values that may be published next, when they were sent, and whether they
        # have to be published.
        self._waiting: Dict[str, Deque[Tuple]] = collections.defaultdict(collections.deque)

    def sent(self, frame: codec.Frame, keys: Callable[[codec.Frame], List], must: bool) -> None:
        for topic, key in keys(frame):      # the Master drops replies while it is out of step
            self._waiting[topic].append((key, time.monotonic(),
                                         must and topic not in POLLED_TOPICS))

    def published(self, topic: str, message: Published) -> None:
        if message.key is None:
            return
        with self._storm.lock:
            waiting = self._waiting[topic]
            keys = [each[0] for each in waiting]
            found = message.key in keys
            passed = keys.index(message.key) + 1 if found else 0
            skipped = [waiting.popleft() for _ in range(passed)][:-1]
        self._sent.check(found, f'{topic} {message.key}')
        self._check_lost(topic, skipped)

    def check_old(self) -> None:
        """Forget what was not published in time."""
        until = time.monotonic() - _KEPT
        for topic, waiting in list(self._waiting.items()):
            with self._storm.lock:
                old = []
                while waiting and waiting[0][1] < until:
                    old.append(waiting.popleft())
            self._check_lost(topic, old)

    def _check_lost(self, topic: str, skipped: List[Tuple[Any, float, bool]]) -> None:
        lost = [(key, at) for key, at, must in skipped if must]
        link = 'mcu' if 'mcu' in topic else 'arduino'
        self._lost.checks += not lost
        for key, at in lost:
            beside = any(which in ('', link) and since - _BESIDE[0] < at < until + _BESIDE[1]
                         for which, since, until in list(self._storm.disturbed))
            if not beside and self._storm.rig.longest_delay(at - 1.0, at + 0.3) > _LATE:
                self._lost.undecided += 1
            else:
                self._lost.check(beside, f'{topic} {key}, sent at {at:.3f}')


class ProcessCheck:
    """Checks the bridge's memory, threads and files."""

    def __init__(self, storm: Storm) -> None:
        self._rig = storm.rig
        self._most: Dict[str, List[float]] = {name: [0.0, 0.0] for name in _GROWTH}
        self._settled = min(_SETTLING / storm.duration, 1 / 3)
        self._hours = storm.duration * (1 - self._settled) / 2 / 3600

    def check(self, share: float) -> None:
        """To be called every few seconds; `share` of the duration has passed."""
        if share < self._settled:
            return
        half = int(share > (1 + self._settled) / 2)
        for name, value in usage_of(self._rig.child_bridge.pid).items():
            most, (noise, per_hour, unit) = self._most[name], _GROWTH[name]
            most[half] = max(most[half], value)
            if half:
                self._rig.row(f'no growth: {name}').at_most(
                    most[1] - most[0], noise + per_hour * self._hours, unit, f'from {most[0]:.1f}')
