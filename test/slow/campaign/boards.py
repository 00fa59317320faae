"""The boards at the far ends of the lines. They record all frames, and number those they send."""
import math
import struct
import time
from collections import Counter, deque
from typing import Any, Callable, Deque, Dict, Iterable, List, NamedTuple, Optional, Set, Tuple

import by_definition as codec
from .lines import Clock, SerialLine

_SILENT = 1.5            # arduino/network_silence: then the bridge drops the output of a pty
_DROPS = 0.5             # s in which it notices that the car talks again
BEAT_MISSED = 0.03       # s without a heartbeat after which the board stops its motor
# Custom messages of the car: a number, a sign of life, and an array with a missing value.
COUNTER, ALIVE, SCAN = range(60, 63)
MISSING = -0x8000         # no value, in SCAN
CLIFF = 0x20             # a custom message of the sensor board
DEPTH, HEIGHT = 0x70, 0x71       # polled functions of the bus board
MEMORY = 0xF0            # a function of the bus board that only raw requests use
PERIODS = {codec.ENVIRONMENT: 0.1, DEPTH: 0.1, HEIGHT: 0.05}     # s, of the polls
POLLS = tuple(PERIODS)
ANNOUNCE = 0xFF          # the function that returns a chunk of its announcement
_NUMBER = {'ros_type': 'std_msgs/UInt32', 'layout': '<I', 'fields': ['data']}
CUSTOM: Dict[str, Dict[str, Any]] = {    # parameters of the bridge that define these
    'arduino/messages': {
        'counter': {'type': COUNTER, **_NUMBER},
        'alive': {'type': ALIVE, 'ros_type': 'std_msgs/Empty', 'layout': '<', 'fields': []},
        'scan': {'type': SCAN, 'ros_type': 'std_msgs/Float32MultiArray', 'layout': '>h*',
                 'fields': ['data'], 'scale': 0.5, 'invalid': MISSING}},
    'mcu/messages': {'cliff': {'type': CLIFF, **_NUMBER, 'maximum': 2 ** 31 - 1}},
    'bus/functions': {
        name: {'cmd2': cmd2, 'ros_type': 'std_msgs/UInt32', 'period': PERIODS[cmd2],
               'reply': {'layout': '<I', 'fields': ['data']}}
        for name, cmd2 in (('depth', DEPTH), ('height', HEIGHT))}}
_MEASUREMENTS = {codec.TICKS: ('~ticks', '<B'), codec.STEERING_ANGLE: ('~steering_angle', '<H'),
                 COUNTER: ('~counter', '<I'), codec.VOLTAGE: ('~voltage', '<f'),
                 codec.IMU: ('~imu', '>11h')}
_STATUS, _UNKNOWN = '<HHHhh', (0x8000, -0x8000, -0x8000)    # of the sensor board; its angles


class Packet(NamedTuple):
    """A packet that the bridge sent to the car, and when it was read."""

    t: float
    type: int
    data: bytes
    beats: int           # heartbeats before it on this connection

    @property
    def number(self) -> int:
        """The speed; -1: it is another packet."""
        return struct.unpack('<h', self.data)[0] if self.type == codec.SPEED else -1

    @property
    def is_stop(self) -> bool:
        return self.type == codec.SPEED and not self.number


Key = Tuple[str, Any]     # a topic, and a value as robot.py converts it


def wire_number(value: float) -> Any:
    """The integer on the wire for this value; the value itself if it is not close to one."""
    number = round(value) if math.isfinite(value) else 0
    return number if abs(value - number) < 0.02 else value


def range_key(millimetres: int) -> Any:
    """The range as REP 117 reports it: a number, or a word if it is out of range."""
    return ('timed out' if millimetres == 0xFFFF else 'near' if millimetres < 30
            else 'far' if millimetres > 2000 else millimetres)


class Board:
    """What all boards have."""

    received_frame_at: codec.FrameAt
    sent_frame_at: codec.FrameAt

    def __init__(self, line: SerialLine) -> None:
        self.line = line
        self.connection = 0
        self._reader = codec.Reader(self.received_frame_at)
        line.on_bytes, line.on_unplugged = self.read, self.start_connection
        line.damage = lambda data: data

    def read(self, data: bytes, now: float) -> None:
        frames = self._reader.feed(data, now)
        for frame, at in zip(frames, self.line.written(len(frames), now)):
            self.received(frame, at)

    def start_connection(self) -> None:
        self._reader.reset()
        self.connection += 1

    def received(self, frame: codec.Frame, now: float) -> None:
        """Called for each frame from the bridge."""

    @staticmethod
    def keys(frame: codec.Frame) -> List[Key]:
        """The topics and values that a frame of the board is published as."""

    def write(self, data: bytes) -> bool:
        return self.line.write(data)


class Car(Board):
    """The model car. It sends a sign of life each 0.1 s while `talks`.

    Attributes:
        gaps: between two heartbeats, if too long: when both were written.
    """

    received_frame_at = sent_frame_at = staticmethod(codec.arduino_at)

    def __init__(self, line: SerialLine, clock: Clock) -> None:
        super().__init__(line)
        self.talks, self.quiet_until = True, 0.0
        self.beats = 0                           # heartbeats received on this connection
        self.all_beats = 0                       # on all connections
        self.gaps: List[Tuple[float, float]] = []
        self.longest_gap = 0.0                   # s, of the others
        self.on_packet: Callable[[Packet], None] = lambda packet: None     # but heartbeats
        self.on_beat: Callable[[float], None] = lambda now: None
        self.beat_at = 0.0                       # when the latest one was written
        self._last_beat = float('inf')           # likewise; inf: a gap is no fault
        self._not_arrived: Set[float] = set()    # when others were written since then
        self._talked_at = self._woke_at = 0.0    # when it talked; also after a silence
        self._clock, self._number = clock, 0
        self._live()

    def _live(self) -> None:
        if self.talks and self.beats and time.monotonic() > self.quiet_until:
            self.write(codec.arduino_packet(ALIVE))
        self._clock.after(0.1, self._live)

    def start_connection(self) -> None:
        super().start_connection()
        self.beats = 0
        self.forget_beat()

    def write(self, data: bytes) -> bool:
        now = time.monotonic()
        self._woke_at = now if now - self._talked_at > _SILENT else self._woke_at
        self._talked_at = now
        return super().write(data)

    def forget_beat(self) -> None:
        """The gap between the previous heartbeat and the next one is no fault of the bridge."""
        self._last_beat = float('inf')

    def received(self, frame: codec.Frame, now: float) -> None:
        self._not_arrived.update(self.line.not_arrived)
        if frame.type != codec.HEARTBEAT:
            self.on_packet(Packet(now, frame.type, frame.data, self.beats))
            return
        self.beats += 1
        self.all_beats += 1
        # When a silence begins and when it ends, the bridge drops what waits in a pseudo terminal:
        # heartbeats that it has written in time. A stall of the bridge is a silence, too.
        if self._last_beat == float('inf'):
            self._woke_at = now
        dropped = self._last_beat < self._woke_at + _DROPS or now > self._talked_at + _SILENT
        if self.line.moved_late:
            gaps, self.gaps = self.gaps, []
            for since, until in gaps:
                self._measure_gaps(since, self.line.moved_late, until)
        self._measure_gaps(self._last_beat, sorted(self._not_arrived) if dropped else (), now)
        self._not_arrived.clear()
        self._last_beat = self.beat_at = now
        self.on_beat(now)

    def _measure_gaps(self, since: float, between: Iterable[float], until: float) -> None:
        times = [since, *(at for at in between if since < at < until), until]
        for before, after in zip(times, times[1:]):
            if after - before >= BEAT_MISSED:
                self.gaps.append((before, after))
            else:
                self.longest_gap = max(self.longest_gap, after - before)

    @staticmethod
    def keys(frame: codec.Frame) -> List[Key]:
        if frame.type == SCAN:
            values = struct.unpack(f'>{len(frame.data) // 2}h', frame.data)
            return [('~scan', tuple(None if each == MISSING else each for each in values))]
        topic, layout = _MEASUREMENTS.get(frame.type, ('', ''))
        if not topic or len(frame.data) != struct.calcsize(layout):
            return []
        values = struct.unpack(layout, frame.data)
        if frame.type == codec.IMU:
            return [(topic, values[:10]), ('~imu/temperature', values[10])]
        if frame.type == codec.VOLTAGE:
            return [(topic, wire_number(values[0] * 1000))]
        return [(topic, values[0])]

    def measure(self) -> None:
        """Send one packet of each type, with the next number."""
        self._number = n = self._number + 1
        for type_, *values in ((codec.TICKS, n % 256), (codec.STEERING_ANGLE, n % 1025),
                               (codec.VOLTAGE, n % 90000 / 1000), (COUNTER, n),
                               (codec.IMU, *imu_values(n))):
            layout = _MEASUREMENTS[type_][1]
            self.write(codec.arduino_packet(type_, struct.pack(layout, *values)))
        self.write(codec.arduino_packet(SCAN, struct.pack('>3h', n % 30000, MISSING, 258)))


def imu_values(n: int) -> Tuple[int, ...]:
    """The values of IMU packet n in the board's axes; its quaternion has the norm 1."""
    angle = n % 3600 / 3600 * math.pi
    axis = 1 + n % 3
    quaternion = [round(16384 * math.cos(angle)), 0, 0, 0]
    quaternion[axis] = round(16384 * math.sin(angle))
    return (*quaternion, n % 30000, -(n % 30011), n % 7, n * 3 % 20011, -(n % 8192), 8192 - n % 99,
            n % 30000 - 15000)


class Sensors(Board):
    """The sensor board."""

    received_frame_at = sent_frame_at = staticmethod(codec.mcu_at)

    def __init__(self, line: SerialLine) -> None:
        super().__init__(line)
        self.seq = 0
        self._number = 0

    @staticmethod
    def keys(frame: codec.Frame) -> List[Key]:
        if frame.type == CLIFF and len(frame.data) == 4:
            return [('mcu/cliff', struct.unpack('<I', frame.data)[0])]
        if frame.type == codec.ADC:
            return [('mcu/adc_status', (frame.number, *struct.unpack('<6H', frame.data)))]
        if frame.type != codec.SENSORS:
            return []
        one, two, *angles = struct.unpack(_STATUS, frame.data)
        known = tuple(angles) != _UNKNOWN
        angles[0] -= 36000 * (angles[0] > 36000)
        return [('mcu/status', (frame.number, known and 0xFFFF not in (one, two), one, two,
                                tuple(angles) if known else (None,) * 3)),
                ('mcu/range_1', range_key(one)), ('mcu/range_2', range_key(two)),
                *known * [('mcu/imu', tuple(angles))]]

    def measure(self) -> None:
        """Send one status; its ranges and angles follow from its number."""
        self._number = n = self._number + 1
        ranges = 0xFFFF if n % 11 == 0 else n % 65535, 0xFFFF if n % 9 == 0 else n * 7 % 2500
        # The heading may be over 360 degrees, but is never 360.
        angles = ((n * 998 + 1) % 47000, n % 9000 - 4500, -(n % 17000)) if n % 7 else _UNKNOWN
        self._send(codec.SENSORS, struct.pack(_STATUS, *ranges, *angles))
        self._send(codec.ADC, struct.pack('<6H', *range(n % 60000, n % 60000 + 6)))

    def cliff(self) -> None:
        self._number = n = self._number + 1
        self._send(CLIFF, struct.pack('<I', n))

    def _send(self, type_: int, payload: bytes) -> None:
        self.seq = (self.seq + 1) % 256
        self.write(codec.mcu_frame(type_, self.seq, payload))


class Request(NamedTuple):
    """A request that the bus board received."""

    t: float
    cmd1: int
    cmd2: int
    data: bytes
    connection: int

    @property
    def key(self) -> Tuple[int, bytes]:
        return self.cmd2, self.data


def reply_frame(cmd1: int, data: bytes = b'') -> bytes:
    return codec.bus_frame(bytes((cmd1,)), data)


OK = b''         # in a reaction: the usual reply


class Fence(NamedTuple):
    """Whether there was a fence before a request that needs one."""

    t: float             # of the request
    holds: bool
    text: str            # describes it


class Reaction(NamedTuple):
    """How a bus board reacts to a request."""

    replies: List[Tuple[float, bytes]] = []     # (delay in s, bytes)
    executes: bool = False


class BusBoard(Board):
    """The main control board. It executes each function immediately and replies OK.

    Attributes:
        react: if set, returns another reaction to a function; None: the usual one.
        check_fence: called for each request that needs one.
    """

    received_frame_at = staticmethod(codec.request_at)
    sent_frame_at = staticmethod(codec.reply_at)

    def __init__(self, line: SerialLine, clock: Clock) -> None:
        super().__init__(line)
        self.executed: 'Counter[Tuple[int, bytes]]' = Counter()
        self.react: Optional[Callable[[Request], Optional[Reaction]]] = None
        self.readings = 0
        self.check_fence: Callable[[Fence], Any] = lambda fence: None
        self.on_request: Callable[[Request], None] = lambda request: None
        self._clock = clock
        self._free_at = 0.0      # when the last delayed reply is written
        self._delayed: Deque[Tuple[int, bytes]] = deque()
        self._before: Optional[Request] = None
        self._nonces: Deque[bytes] = deque(maxlen=1000)
        self._is_new = True          # the latest nonce
        self._echoed: Deque[bytes] = deque(maxlen=100)      # replies to ECHO that were written

    @staticmethod
    def keys(frame: codec.Frame) -> List[Key]:
        if frame.type == codec.OK and len(frame.data) == 6:
            smoke, temperature, humidity = struct.unpack('<HhH', frame.data)
            return [('~environment', (smoke, temperature, humidity)),
                    ('~environment/temperature', temperature), ('~environment/humidity', humidity)]
        if frame.type == codec.OK and len(frame.data) == 4:     # the depth is always even
            number = struct.unpack('<I', frame.data)[0]
            return [('~height' if number % 2 else '~depth', number)]
        return []

    def received(self, frame: codec.Frame, now: float) -> None:
        request = Request(now, *frame.content, self.connection)
        self._look_for_fence(request)
        self.on_request(request)
        reaction = self._reaction(request)
        if reaction.executes:
            self.executed[request.key] += 1
        for seconds, reply in reaction.replies:
            self._write_in_order(seconds, reply or self.ok_reply(request))

    def _look_for_fence(self, request: Request) -> None:
        before, self._before = self._before, request
        if request.cmd1 == codec.ECHO:
            # That of a caller may come again, and is no fence.
            self._is_new = len(request.data) == 4 and not request.cmd2 \
                and request.data not in self._nonces
            self._nonces.append(request.data)
        elif request.cmd1 != codec.SYNC:
            is_same_poll = before and before.key == request.key and request.cmd2 in POLLS
            is_echoed = before and before.cmd1 == codec.ECHO and before.data in self._echoed
            self.check_fence(Fence(
                request.t,
                is_same_poll or is_echoed and self._is_new,
                f'{request} came behind {before}'
                + ', whose CMD2 is not 0, or whose nonce is not new, or has not 4 bytes'
                * (not self._is_new)))

    def write(self, data: bytes) -> bool:
        if data[2:3] == bytes((codec.ECHO,)):
            self._echoed.append(data[3:-1])
        return super().write(data)

    def _write_in_order(self, seconds: float, reply: bytes) -> None:
        """A line keeps the order of its bytes: a delayed reply delays all later ones."""
        now = time.monotonic()
        self._free_at = max(now + seconds, self._free_at)
        if self._free_at <= now and not self._delayed:
            self.write(reply)
        else:
            self._delayed.append((self.connection, reply))
            self._clock.at(self._free_at, self._write_delayed)

    def _write_delayed(self) -> None:
        connection, reply = self._delayed[0]
        if self.connection == connection:
            self.write(reply)
        self._delayed.popleft()

    def start_connection(self) -> None:
        super().start_connection()
        self._free_at, self._before = 0.0, None

    def _reaction(self, request: Request) -> Reaction:
        is_function = request.cmd1 == codec.FUNCTION
        if request.cmd2 == ANNOUNCE:        # it announces nothing
            return Reaction([(0, reply_frame(codec.ERROR, struct.pack('<H', 0x8000)))])
        other = self.react(request) if is_function and self.react else None
        return other or Reaction([(0, OK)], is_function)

    def ok_reply(self, request: Request) -> bytes:
        if request.cmd1 != codec.FUNCTION:
            return reply_frame(request.cmd1, request.data)
        if request.cmd2 not in POLLS:
            return reply_frame(codec.OK, request.data if request.cmd2 == MEMORY else b'')
        self.readings = n = self.readings + 1
        data = struct.pack('<I', 2 * n + (request.cmd2 == HEIGHT))      # the depth is always even
        if request.cmd2 == codec.ENVIRONMENT:
            data = struct.pack('<HhH', n % 65536, n % 20000 - 4000, n % 10001)
        return reply_frame(codec.OK, data)
