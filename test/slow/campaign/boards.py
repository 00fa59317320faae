"""The boards at the far ends of the lines. They record all frames, and number those they send."""
import math
import struct
import time
from collections import Counter, deque
from typing import Any, Callable, Deque, Dict, Iterable, List, NamedTuple, Optional, Set, Tuple

import by_definition as codec
from .lines import Clock, SerialLine

_SILENCE = 0.019        # s; a fence of a board that knows no ECHO
_SILENT = 1.0            # arduino/network_silence: then the bridge drops the output of a pty
_DROPS = 0.5             # s in which it notices that the car talks again
BEAT_MISSED = 0.03       # s without a heartbeat after which the board stops its motor
# Custom messages of the car: a number, bytes and a sign of life that it sends, two commands, a row
# with all keys, one with the board's time, an array with a missing value, an odometry, and a text
# that follows a byte without a field.
COUNTER, BLOB, ALIVE, HEATER, WINCH, FIELD, TIMED, SCAN, PLACE, NOTE = range(60, 70)
HEATER_SCALE, HEATER_OFFSET = 0.01, -20
MISSING = -0x8000         # no value, in FIELD and SCAN
CLIFF = 0x20             # a custom message of the sensor board
# Custom functions of the bus board.
PRESS, PROBE, HALT, PUMP, TICK, QUICK, SWAP, REST, DEPTH, HEIGHT = *range(0x60, 0x68), 0x70, 0x71
PRESS_TIMEOUT = 0.45     # s, of PRESS: neither of the two of rig.py
QUICK_TIMEOUT = 0.05     # s, less than both
MEMORY = 0xF0            # a function of the bus board that only raw requests use
PERIODS = {codec.ENVIRONMENT: 0.1, DEPTH: 0.1, HEIGHT: 0.05}     # s, of the polls
POLLS = tuple(PERIODS)
ANNOUNCE = 0xFF          # the function that returns a chunk of its announcement
_NUMBER = {'ros_type': 'std_msgs/UInt32', 'layout': '<I', 'fields': ['data']}
_TRIGGER = {'srv_type': 'std_srvs/Trigger', 'timeout': 0.3, 'repeatable': True}
CUSTOM: Dict[str, Dict[str, Any]] = {    # parameters of the bridge that define these
    'arduino/messages': {
        'counter': {'type': COUNTER, **_NUMBER},
        'blob': {'type': BLOB, 'ros_type': 'std_msgs/UInt8MultiArray', 'layout': '<B*',
                 'fields': ['data'], 'minimum': 1},
        'alive': {'type': ALIVE, 'ros_type': 'std_msgs/Empty', 'layout': '<', 'fields': []},
        'heater': {'type': HEATER, 'direction': 'to_board', 'ros_type': 'sensor_msgs/Temperature',
                   'layout': '>H', 'fields': ['temperature'], 'scale': HEATER_SCALE,
                   'offset': HEATER_OFFSET, 'maximum': 400},
        'winch': {'type': WINCH, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt16',
                  'layout': '>H', 'fields': ['data']},
        'field': {'type': FIELD, 'ros_type': 'sensor_msgs/MagneticField', 'layout': '<3h',
                  'fields': [f'magnetic_field.{axis}' for axis in 'xyz'], 'scale': [0.5, 0.25, 1],
                  'offset': [10, 0, 0], 'invalid': ['', MISSING, ''], 'frame_id': 'magnet',
                  'constants': {'magnetic_field_covariance': [1.0, 2.0, 3.0]}},
        'timed': {'type': TIMED, 'ros_type': 'sensor_msgs/Temperature', 'layout': '<IB',
                  'fields': ['@time', 'temperature']},
        'scan': {'type': SCAN, 'ros_type': 'std_msgs/Float32MultiArray', 'layout': '>h*',
                 'fields': ['data'], 'scale': 0.5, 'invalid': MISSING},
        'place': {'type': PLACE, 'ros_type': 'nav_msgs/Odometry', 'layout': '<3h',
                  'fields': [*(f'pose.pose.position.{axis}' for axis in 'xy'),
                             'pose.pose.orientation.yaw'], 'scale': [0.001, 0.001, 0.0001],
                  'frame_id': 'odom', 'child_frame_id': 'place'},
        'note': {'type': NOTE, 'ros_type': 'std_msgs/String', 'layout': '<Bs',
                 'fields': ['', 'data']}},
    'mcu/messages': {'cliff': {'type': CLIFF, **_NUMBER, 'maximum': 2 ** 31 - 1}},
    'bus/functions': {
        'press': {'cmd2': PRESS, 'srv_type': 'serial_communication/Lift', 'timeout': PRESS_TIMEOUT,
                  'request': {'layout': '<2B', 'fields': ['direction', 'distance']}},
        'probe': {'cmd2': PROBE, **_TRIGGER},
        'quick': {'cmd2': QUICK, 'srv_type': 'std_srvs/Trigger', 'timeout': QUICK_TIMEOUT},
        'halt': {'cmd2': HALT, 'interrupts': True, **_TRIGGER},
        'swap': {'cmd2': SWAP, 'srv_type': 'serial_communication/BusRequest', 'repeatable': True,
                 'request': {'layout': '>BH', 'fields': ['cmd1', 'cmd2'], 'maximum': 100},
                 'reply': {'layout': '<B*', 'fields': ['data'], 'scale': 2}},
        'rest': {'cmd2': REST, 'srv_type': 'std_srvs/Empty'}}}
POLLED = {name: {'cmd2': cmd2, 'ros_type': 'std_msgs/UInt32', 'period': PERIODS[cmd2],
                 'reply': {'layout': '<I', 'fields': ['data']}}
          for name, cmd2 in (('depth', DEPTH), ('height', HEIGHT))}
PUMP_ROWS = b'''pump: {cmd2: %d, srv_type: std_srvs/Trigger, timeout: 0.3}
tick: {cmd2: %d, ros_type: std_msgs/Empty, period: 0.1}''' % (PUMP, TICK)


class Sent(NamedTuple):
    """A value that a board sent."""

    topic: str
    key: Any
    wall: float      # time.time() before it was written


_COMMANDS = {codec.SPEED: '<h', codec.STEERING: '<H', WINCH: '>H', HEATER: '>H'}
_MEASUREMENTS = {codec.TICKS: ('~ticks', '<B'), codec.STEERING_ANGLE: ('~steering_angle', '<H'),
                 COUNTER: ('~counter', '<I'), codec.VOLTAGE: ('~voltage', '<f'),
                 codec.IMU: ('~imu', '>11h'), FIELD: ('~field', '<3h'),
                 PLACE: ('~place', '<3h')}
_STATUS, _UNKNOWN = '<HHHhh', (0x8000, -0x8000, -0x8000)    # of the sensor board; its angles


class Packet(NamedTuple):
    """A packet that the bridge sent to the car, and when it was read."""

    t: float
    type: int
    data: bytes
    beats: int           # heartbeats before it on this connection

    @property
    def number(self) -> int:
        """The number of the command; -1: it has none."""
        if self.type == codec.LED:      # the text is a letter and the number
            return int(self.data[1:-1]) if self.data[1:-1].isdigit() else -1
        layout = _COMMANDS.get(self.type)
        return struct.unpack(layout, self.data)[0] if layout else -1

    @property
    def is_stop(self) -> bool:
        return self.type == codec.SPEED and not self.number


Key = Tuple[str, Any]     # a topic, and a value as robot.py converts it


def wire_number(value: float) -> Any:
    """The integer on the wire for this value; the value itself if it is not close to one."""
    number = round(value) if math.isfinite(value) else 0
    return number if abs(value - number) < 0.02 else value


def unit_key(quaternion: Tuple[float, ...]) -> Tuple[int, ...]:
    """The quaternion with a norm of 10000, rounded."""
    norm = math.sqrt(sum(part * part for part in quaternion))
    return tuple(round(part / norm * 1e4) for part in quaternion)


def range_key(millimetres: int) -> Any:
    """The range as REP 117 reports it: a number, or a word if it is out of range."""
    return ('timed out' if millimetres == 0xFFFF else 'near' if millimetres < 30
            else 'far' if millimetres > 2000 else millimetres)


class Board:
    """Records the values and the bytes that it sends, until `clear_records`."""

    received_frame_at: codec.FrameAt
    sent_frame_at: codec.FrameAt

    def __init__(self, line: SerialLine) -> None:
        self.line = line
        self.connection = 0
        self.sent: List[Sent] = []
        self.written: List[bytes] = []      # valid and invalid frames
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

    def clear_records(self) -> None:
        self.sent.clear()
        self.written.clear()

    def received(self, frame: codec.Frame, now: float) -> None:
        """Called for each frame from the bridge."""

    @staticmethod
    def keys(frame: codec.Frame) -> List[Key]:
        """The topics and values that a frame of the board is published as."""

    def write(self, data: bytes) -> bool:
        return self.line.write(data) and not self.written.append(data)

    def send(self, data: bytes) -> None:
        """Send a frame whose values have to be published."""
        wall = time.time()
        if self.write(data):
            self._remember(data, wall)

    def _remember(self, data: bytes, wall: float) -> None:
        self.sent += [Sent(*key, wall) for frame in codec.decode(data, self.sent_frame_at)[0]
                      for key in self.keys(frame)]


class Car(Board):
    """The model car. It sends a sign of life each 0.1 s while `talks`.

    Attributes:
        gaps: between two heartbeats, if too long: when both were written.
    """

    received_frame_at = sent_frame_at = staticmethod(codec.arduino_at)

    def __init__(self, line: SerialLine, clock: Clock) -> None:
        super().__init__(line)
        self.talks, self.quiet_until = True, 0.0
        self.packets: List[Packet] = []          # without heartbeats
        self.beats = 0                           # heartbeats received on this connection
        self.all_beats = 0                       # on all connections
        self.gaps: List[Tuple[float, float]] = []
        self.longest_gap = 0.0                   # s, of the others
        self.first: Optional[Packet] = None      # of this connection
        self.last: Optional[Packet] = None       # also if it is a heartbeat
        self.on_packet: Callable[[Packet], None] = self.packets.append
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
        self.beats, self.first = 0, None
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
        packet = self.last = Packet(now, frame.type, frame.data, self.beats)
        self.first = self.first or packet
        self._not_arrived.update(self.line.not_arrived)
        if frame.type != codec.HEARTBEAT:
            self.on_packet(packet)
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

    def clear_records(self) -> None:
        super().clear_records()
        self.packets.clear()

    def commands(self, type_: int, since: int = 0) -> List[int]:
        return [packet.number for packet in self.packets[since:] if packet.type == type_]

    def packet(self, type_: int, value: int, since: int = 0) -> Optional[Packet]:
        return next((packet for packet in self.packets[since:]
                     if packet.type == type_ and packet.number == value), None)

    def stop_after(self, packet: Packet) -> Optional[Packet]:
        """The first SPEED 0 after this packet."""
        at = self.packets.index(packet)
        return next((each for each in self.packets[at + 1:] if each.is_stop), None)

    @staticmethod
    def keys(frame: codec.Frame) -> List[Key]:
        if frame.type == BLOB:
            return [('~blob', frame.data)]
        if frame.type == NOTE:
            return [('~note', frame.data[1:].split(b'\0')[0].decode())]
        if frame.type == SCAN:
            values = struct.unpack(f'>{len(frame.data) // 2}h', frame.data)
            return [('~scan', tuple(None if each == MISSING else each for each in values))]
        topic, layout = _MEASUREMENTS.get(frame.type, ('', ''))
        if not topic or len(frame.data) != struct.calcsize(layout):
            return []
        values = struct.unpack(layout, frame.data)
        if frame.type == codec.IMU:
            return [(topic, values[:10]), ('~imu/temperature', values[10]),
                    ('tf/imu_orientation', unit_key(values[:4]))]
        if frame.type == FIELD:
            return [(topic, (values[0], None if values[1] == MISSING else values[1], values[2]))]
        if frame.type == PLACE:
            return [(topic, values), ('tf/place', values[2])]
        if frame.type == codec.VOLTAGE:
            return [(topic, wire_number(values[0] * 1000))]
        return [(topic, values[0])]

    def measure(self) -> None:
        """Send one packet of each type, with the next number."""
        self._number = n = self._number + 1
        for type_, *values in ((codec.TICKS, n % 256), (codec.STEERING_ANGLE, n % 1025),
                               (codec.VOLTAGE, n % 90000 / 1000), (COUNTER, n),
                               (codec.IMU, *imu_values(n)), (FIELD, *field_values(n)),
                               (PLACE, n % 30000, -(n % 30001), n % 62000 - 31000)):
            layout = _MEASUREMENTS[type_][1]
            self.send(codec.arduino_packet(type_, struct.pack(layout, *values)))
        self.send(codec.arduino_packet(SCAN, struct.pack('>3h', n % 30000, MISSING, 258)))


def imu_values(n: int) -> Tuple[int, ...]:
    """The values of IMU packet n in the board's axes; its quaternion has the norm 1."""
    angle = n % 3600 / 3600 * math.pi
    axis = 1 + n % 3
    quaternion = [round(16384 * math.cos(angle)), 0, 0, 0]
    quaternion[axis] = round(16384 * math.sin(angle))
    return (*quaternion, n % 30000, -(n % 30011), n % 7, n * 3 % 20011, -(n % 8192), 8192 - n % 99,
            n % 30000 - 15000)


def field_values(n: int) -> Tuple[int, int, int]:
    """The values of FIELD packet n."""
    return n % 30000, -(n % 30001) if n % 5 else MISSING, n % 29999 - 15000


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
                *known * [('mcu/imu', tuple(angles)), ('tf/mcu_imu_orientation', tuple(angles))]]

    def frame(self, type_: int, payload: bytes) -> bytes:
        self.seq = (self.seq + 1) % 256
        return codec.mcu_frame(type_, self.seq, payload)

    def status(self, *numbers: int) -> bytes:
        """The frame of a status: two ranges in mm, then yaw, pitch and roll in 0.01 degrees."""
        return self.frame(codec.SENSORS, struct.pack(_STATUS, *numbers))

    def measure(self) -> None:
        """Send one status; its ranges and angles follow from its number."""
        self._number = n = self._number + 1
        ranges = 0xFFFF if n % 11 == 0 else n % 65535, 0xFFFF if n % 9 == 0 else n * 7 % 2500
        # The heading may be over 360 degrees, but is never 360.
        angles = ((n * 998 + 1) % 47000, n % 9000 - 4500, -(n % 17000)) if n % 7 else _UNKNOWN
        self.send(self.status(*ranges, *angles))
        self.send(self.frame(codec.ADC, struct.pack('<6H', *range(n % 60000, n % 60000 + 6))))

    def cliff(self) -> None:
        self._number = n = self._number + 1
        self.send(self.frame(CLIFF, struct.pack('<I', n)))


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


_NO_CHUNK = reply_frame(codec.ERROR, struct.pack('<H', 0x8000))
_OUT_OF_STEP = reply_frame(codec.INVALID, bytes((codec.NOT_SYNCHRONISED,)))
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
        probe: likewise to SYNC and ECHO.
        in_step: False after a reset, until a SYNC.
        echoes: whether it knows ECHO; if not, a silence is the fence.
        announces: the chunks of its announcement.
        lost_questions: so many questions for them are not answered.
        reply_has_cmd2: its replies have the CMD2 of their requests.
        check_fence: called for each request that needs one.
    """

    received_frame_at = staticmethod(codec.request_at)
    sent_frame_at = staticmethod(codec.reply_at)

    def __init__(self, line: SerialLine, clock: Clock) -> None:
        super().__init__(line)
        self.requests: List[Request] = []
        self.executed: 'Counter[Tuple[int, bytes]]' = Counter()
        self.react: Optional[Callable[[Request], Optional[Reaction]]] = None
        self.probe: Optional[Callable[[Request], Optional[Reaction]]] = None
        self.in_step, self.echoes = True, True
        self.announces: List[bytes] = []
        self.lost_questions = 0
        self.reply_has_cmd2 = False
        self.readings = 0
        self.check_fence: Callable[[Fence], Any] = lambda fence: None
        self.on_request: Callable[[Request], None] = self.requests.append
        self.written_at = 0.0
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

    @property
    def connection_requests(self) -> List[Request]:
        """The requests since the port was opened."""
        return [each for each in self.requests if each.connection == self.connection]

    def count(self, cmd2: int) -> int:
        """How many requests of this function were received."""
        return [each.cmd2 for each in self.requests].count(cmd2)

    def received(self, frame: codec.Frame, now: float) -> None:
        request = Request(now, *frame.content, self.connection)
        self._look_for_fence(request)
        self.on_request(request)
        reaction = self._reaction(request)
        if reaction.executes:
            self.executed[request.key] += 1
        for seconds, reply in reaction.replies:
            reply = reply or self.ok_reply(request)
            if self.reply_has_cmd2:
                frame = codec.decode(reply, self.sent_frame_at)[0][0]
                reply = codec.bus_frame(bytes((frame.type, request.cmd2)), frame.data)
            self._write_in_order(seconds, reply)

    def _look_for_fence(self, request: Request) -> None:
        before, self._before = self._before, request
        if request.cmd1 == codec.ECHO:
            # That of a caller may come again, and is no fence.
            self._is_new = len(request.data) == 4 and not request.cmd2 \
                and request.data not in self._nonces
            self._nonces.append(request.data)
        elif request.cmd1 != codec.SYNC and request.cmd2 != HALT:      # a stop needs no fence
            is_same_poll = before and before.key == request.key and request.cmd2 in (*POLLS, TICK)
            is_echoed = before and before.cmd1 == codec.ECHO and before.data in self._echoed
            is_silent = not self.echoes and request.t - self.written_at >= _SILENCE
            self.check_fence(Fence(
                request.t,
                is_same_poll or is_echoed and self._is_new or is_silent,
                f'{request} came behind {before}'
                + ', whose CMD2 is not 0, or whose nonce is not new, or has not 4 bytes'
                * (not self._is_new)))

    def write(self, data: bytes) -> bool:
        self.written_at = time.monotonic()
        if data[2:3] == bytes((codec.ECHO,)):
            self._echoed.append(data[3 + self.reply_has_cmd2:-1])
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

    def clear_records(self) -> None:
        super().clear_records()
        self.requests.clear()
        self.executed.clear()

    def usual(self) -> None:
        """React as usual from now on."""
        self.react, self.probe, self.in_step = None, None, True

    def _reaction(self, request: Request) -> Reaction:
        is_function = request.cmd1 == codec.FUNCTION
        self.in_step = self.in_step or request.cmd1 == codec.SYNC
        if not is_function and self.probe:
            other = self.probe(request)
        elif not self.in_step:
            other = Reaction([(0, _OUT_OF_STEP)])
        elif request.cmd2 == ANNOUNCE and self.lost_questions:
            self.lost_questions -= 1
            other = Reaction()
        elif request.cmd2 == ANNOUNCE:
            chunks = self.announces[request.data[0]:]
            other = Reaction([(0, reply_frame(codec.OK, chunks[0]) if chunks else _NO_CHUNK)])
        else:
            other = self.react(request) if is_function and self.react else None
        return other or Reaction([(0, OK)], is_function)

    def ok_reply(self, request: Request) -> bytes:
        if request.cmd1 != codec.FUNCTION:
            return reply_frame(request.cmd1, request.data)
        if request.cmd2 not in POLLS:
            return reply_frame(codec.OK, request.data if request.cmd2 == MEMORY
                               else request.data[::-1] if request.cmd2 == SWAP else b'')
        self.readings = n = self.readings + 1
        data = struct.pack('<I', 2 * n + (request.cmd2 == HEIGHT))      # the depth is always even
        if request.cmd2 == codec.ENVIRONMENT:
            data = struct.pack('<HhH', n % 65536, n % 20000 - 4000, n % 10001)
        reply = reply_frame(codec.OK, data)
        self._remember(reply, time.time())
        return reply
