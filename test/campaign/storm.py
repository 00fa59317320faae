"""The statistical part: all faults at once, and damage on every line, for as long as one likes.

What is promised is only what holds whatever the damage was, and all that is taken for true is what
stands on the lines:

- What the bridge writes is read before the line damages it. Times there are counted in heartbeats.
- What it publishes, or tells a caller, has to stand in the bytes that reached it: in a frame that a
  board sent or, where there is none, in any valid frame at any place of those bytes.

A line that freezes is no part of it, nor any promise about order and loss. Memory is bounded: each
judgement is made as things happen, from what happened in the latest seconds.
"""
import collections
import functools
import random
import signal
import struct
import threading
import time
from typing import Any, Callable, Deque, Dict, List, Optional, Tuple

from heartbeats import BEAT_MISSED, longest_gap
from processes import usage_of
import by_definition as codec
from .boards import (DEPTH, HEIGHT, MEMORY, Answer, BusBoard, Car, Key, Request, Sensors, car_keys,
                     reply, reply_keys, sensor_keys)
from .exact_bus import WAIT
from .exact_node import POLLING
from .field import MOTION_TIMEOUT, POLLED_TOPICS, REPLY_TIMEOUT, SPEED_TIMEOUT, Field
from .robot import NOT_SENT, TIMEOUT, Got, Told
from .rows import Row

KEPT = 12.0              # s for which bytes, commands and calls are remembered
_UNDER_WAY = 3.0         # s from a frame to what is published of it, stops included
_RATE = 0.03             # of writes that are damaged
_TALK = 0.02             # s from one measurement to the next
_LATE_ZERO = 0.05        # s that SPEED 0 may come later than speed_timeout
_ON_ITS_WAY = 1.5        # s for which a command may be under way, to be read here in the end
_BEATS = 100             # heartbeats that are looked at together …
_BEHIND = 400            # … and behind them, where a gap may be none: they were read late
_LEVELS = {'memory': (4.0, 'MB'), 'threads': (4, 'more'), 'files': (6, 'more')}    # may grow so
_SETTLING = 60.0         # s, or a third of a shorter part
_RECORDS = 20000         # that are kept until a violation asks for them
_DUMPS = 10              # violations whose records are written


class Wire:
    """The bytes that reached the bridge on one link lately, and what a valid frame in them says."""

    def __init__(self, frame_at: codec.FrameAt, keys: Callable[[codec.Frame], List[Key]]) -> None:
        self._frame_at = frame_at
        self._keys = keys
        self._pieces: Deque[Tuple[float, bytes, bytes]] = collections.deque()
        self._sent: Dict[Key, float] = {}
        self._lock = threading.Lock()

    def carried(self, clean: bytes, damaged: bytes, now: float) -> None:
        """A board writes `clean`; the bridge gets `damaged`. `now`: as time.time() has it."""
        with self._lock:
            self._pieces.append((now, clean, damaged))
            if clean == damaged:
                for frame in codec.decode(clean, self._frame_at)[0]:
                    for key in self._keys(frame):
                        self._sent.pop(key, None)
                        self._sent[key] = now
            while self._pieces[0][0] < now - KEPT:
                self._pieces.popleft()
            while self._sent and next(iter(self._sent.values())) < now - KEPT:
                del self._sent[next(iter(self._sent))]

    def written(self, key: Key) -> Optional[float]:
        """When an undamaged frame said so last; None: none did lately."""
        with self._lock:
            return self._sent.get(key)

    def any_frame(self, fits: Callable[[codec.Frame], Any], since: float, made: bool) -> bool:
        """Whether a valid frame at any place of what came since then is such a one; where it has to
        be `made` by damage, one that the board did not send."""
        with self._lock:
            pieces = [(clean, data) for t, clean, data in self._pieces if t >= since]
        stream, sent = b''.join(data for _clean, data in pieces), {clean for clean, _data in pieces}
        return any(fits(frame) and not (made and stream[frame.start:frame.end] in sent)
                   for frame in codec.all_frames(stream, self._frame_at))

    def might_say(self, key: Key) -> bool:
        since = time.time() - _UNDER_WAY
        return self.any_frame(lambda frame: key in self._keys(frame), since, False)


def damage(data: bytes, rand: random.Random, twice: bool) -> bytes:
    """What a line may do to bytes: bits flip, bytes are lost or come from nowhere; and, where
    asked for, come twice: not on the way to a board, which would execute a request twice."""
    at = rand.randrange(len(data))
    noise = bytes(rand.choice((0xA5, 0x5A, 0x02, 0x03, 0x00, rand.randrange(256)))
                  for _ in range(rand.choice((1, 2, 3, 8, 20, 60))))
    return data[:at] + rand.choice((
        bytes((data[at] ^ 1 << rand.randrange(8),)) + data[at + 1:],
        data[at + rand.randrange(1, 4):], noise + data[at:], data[at:] * (1 + twice)))


class Storm:
    """One stretch of it, beside so many `busy` processes that take what CPU they get."""

    def __init__(self, field: Field, duration: float, seed: str, busy: int) -> None:
        self.__name__ = f'everything at once, for {duration:g} s'
        self.field = field
        self.duration = duration
        self._busy = busy
        self._random = random.Random(f'storm {seed}')
        self._stopping = threading.Event()
        self._damaging = threading.Lock()
        self._records: Deque[Tuple] = collections.deque(maxlen=_RECORDS)
        self._dumps = 0
        self._damaged = field.row('storm', 'writes that were damaged, either way', True)
        self.blind = field.row('storm', 'calls and values of valid frames that damage made', True)
        self.wires = {'arduino': Wire(codec.arduino_at, car_keys),
                      'mcu': Wire(codec.mcu_at, sensor_keys),
                      'bus': Wire(codec.reply_at, reply_keys)}
        self.motor = MotorJudge(self)
        self.calls = CallJudge(self)
        self.published = PublishedJudge(self)
        self._node = NodeJudge(self)

    def record(self, *what: Any) -> None:
        self._records.append((round(time.monotonic(), 4), *what))

    def check(self, row: Row, holds: Any, text: str) -> bool:
        """One try. The records of the latest time are written where it does not hold."""
        if row.check(holds, text):
            return True
        self.record('VIOLATED', row.promise, text)
        if self._dumps < _DUMPS:
            self._dumps += 1
            with open(self.field.path(f'violation_{self._dumps}.txt'), 'w') as file:
                file.writelines(f'{record}\n' for record in list(self._records))
        return False

    def __call__(self, field: Field) -> None:
        field.start(POLLING)
        self.car, self.sensors = Car(field.car_line), Sensors(field.mcu_line)
        self.bus = BusBoard(field.bus_line, field.clock)
        self.bus.readings = field.bus.readings + 1000     # no number of the board before it
        self._connect_lines()
        field.robot.listen_to_traffic()
        listener = field.user('listener', 'storm_listener')
        busy = field.busy(self._busy)
        threads = [threading.Thread(target=self._guarded, args=(loop,), daemon=True) for loop in (
            self._talk, self._drive, self.calls.raw, self.calls.raw,
            lambda: self._plug('mcu', 4.0), lambda: self._plug('bus', 6.0),
            lambda: self._plug('arduino', 5.0), lambda: self._stop_listener(listener))]
        for thread in threads:
            thread.start()
        began = time.monotonic()
        try:
            while time.monotonic() < began + self.duration:
                self._stopping.wait(self._random.uniform(2.0, 6.0))
                self._hold_bridge()
                self._node.look((time.monotonic() - began) / self.duration)
                field.check(field.child_bridge)
        finally:
            self._stopping.set()
            for thread in threads:
                thread.join(5.0)
            self.calls.finish()
            self._disconnect_lines()
            for child in (listener, *busy):
                field.end(child)

    def _guarded(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except Exception as error:  # pylint: disable=broad-except
            row = self.field.row('campaign', 'every scenario can be carried out to its end')
            self.check(row, False, f'{loop}: {type(error).__name__}: {error}')
            raise

    def wait(self, seconds: float) -> bool:
        """Sleep; whether it goes on then."""
        return not self._stopping.wait(seconds)

    def _connect_lines(self) -> None:
        """Boards that remember nothing, behind lines that damage what they carry."""
        field = self.field
        self.bus.rule, self.bus.executed = self._bus_rule, self.calls.executed
        self.car.on_packet, self.bus.on_request = (lambda packet: None), (lambda request: None)
        for link, board in (('arduino', self.car), ('bus', self.bus), ('mcu', self.sensors)):
            board.sent = board.said = collections.deque(maxlen=0)
            board.line.to_bridge = functools.partial(self._to_bridge, link)
            board.line.take = functools.partial(self._to_board, link, board.line.take)
        self.car.line.cut = lambda: (self.motor.open_anew(), self.car.open_anew())
        for topic in POLLED_TOPICS:     # a value from before cannot arrive after this one
            field.wait(lambda: any(self.wires['bus'].written((topic, got.key))
                                   for got in list(field.robot.got[topic])), f'a value of {topic}')
        field.robot.on_message = self.published.take

    def _disconnect_lines(self) -> None:
        field = self.field
        field.robot.listen_to_traffic(False)
        field.robot.on_message = field.robot.keep
        for board in (field.car, field.bus, field.sensors):
            board.line.to_bridge = lambda data: data
            board.attach()

    def _to_bridge(self, link: str, data: bytes) -> bytes:
        sent = self._carry(data, True)
        self.wires[link].carried(data, sent, time.time())
        self.record(link, 'to the bridge', data.hex(), sent.hex() if sent != data else '')
        return sent

    def _carry(self, data: bytes, twice: bool) -> bytes:
        with self._damaging:
            if self._random.random() >= _RATE:
                return data
            self._damaged.tries += 1
            return damage(data, self._random, twice)

    def _to_board(self, link: str, take: Callable, data: bytes, now: float) -> None:
        if link == 'arduino':
            self.motor.read(data, now)
        came = self._carry(data, False)
        if data.strip(b'\x02\x0b\x00'):         # not only heartbeats
            self.record(link, 'to the board', data.hex(), came.hex() if came != data else '')
        take(came, now)
        nothing = link == 'bus' and not codec.decode(came, codec.request_at, True)[0]
        if nothing and self._random.random() < 0.5:
            self.bus.line.write(reply(codec.INVALID, bytes((codec.BAD_CHECKSUM,))))

    def _bus_rule(self, request: Request) -> Optional[Answer]:
        if request.cmd2 in (DEPTH, HEIGHT, codec.ENVIRONMENT):
            return None
        ok = self.bus.ok(request)
        return self._random.choice((
            *[Answer([(0, reply(codec.ERROR, struct.pack('<H', codec.FAILED)))])] * 2,
            Answer([(0, reply(codec.INVALID, bytes((codec.BAD_CHECKSUM,))))]),
            Answer([], self._random.random() < 0.5), Answer([(MOTION_TIMEOUT + 0.1, ok)], True),
            *[Answer([(0, ok), (0.005, ok)], True)] * 2,
            *[Answer([(self._random.choice((0, 0, 0.01)), ok)], True)] * 13))

    def _talk(self) -> None:
        while self.wait(_TALK):
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

    def _plug(self, link: str, seconds: float) -> None:
        line, rand = self.field.lines[link], random.Random(f'{link} {self._random.random()}')
        while self.wait(rand.uniform(0.5, 2 * seconds)):
            self.record(link, 'unplugged')
            line.unplug()
            self.wait(rand.uniform(0.05, 1.0))
            self.record(link, 'plugged')
            line.plug(another_name=rand.random() < 0.3)

    def _stop_listener(self, listener: Any) -> None:
        while self.wait(self._random.uniform(0.5, 2.0)):
            listener.hold()
            self.wait(self._random.uniform(2.0, 6.0))
            listener.send(signal.SIGCONT)

    def _hold_bridge(self) -> None:
        with self.field.held():
            self.motor.stands()
            self.record('bridge', 'stopped')
            self.wait(self._random.choice((0.1, 0.8, 1.5)))
            self.motor.stands()
            self.record('bridge', 'continued')


class MotorJudge:
    """What the bridge wrote to the car, before the line damaged it."""

    def __init__(self, storm: Storm) -> None:
        row = storm.field.row
        self._storm = storm
        self._commanded = row('storm: motor', 'no speed that was not commanded, none twice')
        self._age = row('storm: motor', 'no speed of before a reconnect')
        self._zero = row('storm: motor', 'SPEED 0 within speed_timeout + 50 ms, by heartbeats')
        self._first = row('storm: motor', 'at every opening SPEED 0 goes out before any heartbeat')
        self._gap = row('storm: motor', 'no gap of 30 ms between heartbeats while the port is open')
        self._reader = codec.Reader(codec.arduino_at, float('inf'))
        self._commands: Dict[int, Tuple[float, int]] = {}    # when, at which connection (-1: none)
        self._connection = 0
        self._is_first = False
        self._moving_since: Optional[int] = None     # heartbeats since the latest speed but 0
        self._beats: List[float] = []
        self._lock = threading.RLock()

    def command(self, value: int) -> None:
        plugged = self._storm.field.car_line.plugged
        with self._lock:
            if value:
                self._commands[value] = time.monotonic(), self._connection if plugged else -1
        self._storm.record('speed', value)
        self._storm.field.robot.command('speed', value, time.time())

    def open_anew(self) -> None:
        with self._lock:
            self._reader.reset()
            self._connection += 1
            self._is_first = True
            self._moving_since = None
            self._beats.clear()

    def stands(self) -> None:
        """The bridge has been stopped, or is to go on now."""
        with self._lock:
            self._beats.clear()

    def read(self, data: bytes, now: float) -> None:
        with self._lock:
            for frame in self._reader.feed(data, now):
                speed = struct.unpack('<h', frame.data)[0] if frame.type == codec.SPEED else None
                if self._is_first:
                    self._storm.check(self._first, speed == 0, f'{frame.content} was the first')
                self._is_first = False
                if frame.type == codec.HEARTBEAT:
                    self._beat(now)
                elif speed:
                    self._speed(speed, now)
                if speed is not None:
                    self._moving_since = 0 if speed else None

    def _speed(self, speed: int, now: float) -> None:
        commanded, connection = self._commands.pop(speed, (0.0, 0))
        if self._storm.check(self._commanded, commanded, f'SPEED {speed} at {now:.3f}'):
            if connection != self._connection and now - commanded < _ON_ITS_WAY:
                self._age.undecided += 1      # it may have reached the bridge behind the reconnect
                return
            self._age.note(now - commanded, 's')
            self._storm.check(self._age, connection == self._connection, f'SPEED {speed} commanded '
                              f'{now - commanded:.3f} s ago at connection {connection}, read at '
                              f'{self._connection}')

    def _beat(self, now: float) -> None:
        if self._moving_since is not None:
            self._moving_since += 1
            limit = round((SPEED_TIMEOUT + _LATE_ZERO) / 0.01) + 1
            self._zero.note(self._moving_since * 10.0, 'ms')
            self._storm.check(self._zero, self._moving_since <= limit,
                              f'{self._moving_since} heartbeats since the latest speed')
        self._beats.append(now)
        if len(self._beats) % _BEATS == 0:
            self._judge_gaps()

    def _judge_gaps(self) -> None:
        """No later than this were they sent, however late they were read. Of a bridge that may
        have no real-time priority nobody can tell whether it, or the machine, was late."""
        gap, field = longest_gap(self._beats, 100.0), self._storm.field
        if gap >= BEAT_MISSED and len(self._beats) < _BEATS + _BEHIND:
            return
        since, tries = self._beats[0], len(self._beats) - 1
        del self._beats[:-1]
        if gap >= BEAT_MISSED and (not field.has_priority() or field.was_starved(gap, since)):
            self._gap.undecided += 1
            return
        self._gap.tries += tries - 1
        self._gap.note(gap * 1e3, 'ms')
        self._storm.check(self._gap, gap < BEAT_MISSED, f'{gap * 1e3:.1f} ms')


class CallJudge:
    """What callers were told, against what the board did and what stood on the line."""

    def __init__(self, storm: Storm) -> None:
        row = storm.field.row
        self._storm = storm
        self._told = {
            'success': row('storm: bus', 'told success: executed exactly once'),
            'refused': row('storm: bus', 'told refused or not sent: not executed'),
            'timeout': row('storm: bus', 'told timeout: executed once or not at all')}
        self._own = row('storm: bus', 'a raw call is answered with its own data')
        self._answers = row('storm: bus', 'a call always answers (worst: beyond timeout + 0.8 s)')
        self.executed: 'collections.Counter[Tuple[int, bytes]]' = collections.Counter()
        self._numbers = iter(range(1, 1 << 32))
        self._open: Deque[Tuple[float, Callable[[], None]]] = collections.deque()
        self._lock = threading.RLock()

    def raw(self) -> None:
        while self._storm.wait(0.01):
            with self._lock:
                key = MEMORY, struct.pack('<I', next(self._numbers))
            began = time.time()
            told = self._storm.field.robot.call('bus/request', codec.FUNCTION, *key)
            self._storm.record('told', key[1].hex(), told)
            self._answers.note(told.seconds - REPLY_TIMEOUT - WAIT, 's')
            # What is late or doubled has come by then.
            with self._lock:
                self._open.append((began, functools.partial(self._judge, key, told, began)))
                while self._open and self._open[0][0] < time.time() - KEPT / 3:
                    self._open.popleft()[1]()

    def finish(self) -> None:
        while self._open:
            self._open.popleft()[1]()

    def _judge(self, key: Tuple[int, bytes], told: Told, began: float) -> None:
        executed = self.executed.pop(key, 0)
        if not self._storm.check(self._answers, told.status is not None, told.message):
            return
        how = 'success' if told.success else 'timeout' if told.status == TIMEOUT else 'refused'
        text = (f'{key[1].hex()}: told {told.status} "{told.message}", executed {executed} times, '
                f'data {told.data.hex()}')
        holds = {'success': executed == 1, 'refused': not executed, 'timeout': executed <= 1}[how]
        own = not told.success or told.data == key[1]
        if not (holds and own) and self._made_by_damage(told, key, began):
            self._storm.blind.tries += 1
            return
        self._storm.check(self._told[how], holds, text)
        if told.success:
            self._storm.check(self._own, own, text)

    def _made_by_damage(self, told: Told, key: Tuple[int, bytes], began: float) -> bool:
        """Whether a valid frame on the line said what the caller was told, and no board did."""
        if told.status == NOT_SENT:
            return False
        return self._storm.wires['bus'].any_frame(
            lambda frame: frame.type == told.status and frame.data == told.data
            and frame.data != key[1] if told.success else frame.type == told.status, began, True)


class PublishedJudge:
    """What was published, against what stood on the lines."""

    def __init__(self, storm: Storm) -> None:
        row = storm.field.row
        self._storm = storm
        self._rows = {link: row(f'storm: {link}', 'no value that no valid frame on the line had')
                      for link in storm.wires}

    def take(self, topic: str, got: Got) -> None:
        if got.key is None:
            return
        link = ('bus' if topic in POLLED_TOPICS else 'mcu' if topic.startswith('mcu/')
                else 'arduino')
        wire, key = self._storm.wires[link], (topic, got.key)
        written = wire.written(key)
        if written is None and wire.might_say(key):
            self._storm.blind.tries += 1
            return
        self._storm.check(self._rows[link], written, f'{topic} {got.key}')


class NodeJudge:
    """The process: what it takes, and what it says."""

    def __init__(self, storm: Storm) -> None:
        row = storm.field.row
        self._field = storm.field
        self._most: Dict[str, List[float]] = {name: [0.0, 0.0] for name in _LEVELS}
        self._settled = min(_SETTLING / storm.duration, 1 / 3)
        self._levels = {name: row('storm: node', f'level: {name}') for name in _LEVELS}

    def look(self, share: float) -> None:
        """Once in a while; `share` of the time has passed."""
        self._field.logs.look()
        if share < self._settled:
            return
        half = int(share > (1 + self._settled) / 2)
        for name, value in usage_of(self._field.child_bridge.pid).items():
            most, (slack, unit) = self._most[name], _LEVELS[name]
            most[half] = max(most[half], value)
            if half:
                self._levels[name].at_most(most[1] - most[0], slack, unit,
                                           f'from {most[0]:.1f} to {most[1]:.1f}')
