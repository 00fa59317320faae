"""The boards at the far ends of the lines. They record all frames, and number those they send."""
import math
import struct
import time
from collections import Counter, deque
from typing import Any, Callable, Deque, Dict, List, NamedTuple, Optional, Tuple

import by_definition as codec
from .lines import Clock, SerialLine

PERIOD = 0.01            # s from one heartbeat to the next
COUNTER, WINCH = 60, 62  # custom messages of the car: a number that it sends, a command
CLIFF = 0x20             # a custom message of the sensor board
PRESS, PROBE, DEPTH, HEIGHT = 0x60, 0x61, 0x70, 0x71     # custom functions of the bus board
MEMORY = 0xF0            # a function of the bus board that only raw requests use
CUSTOM: Dict[str, Dict[str, Any]] = {    # parameters of the bridge that define these
    'arduino/messages': {
        'counter': {'type': COUNTER, 'ros_type': 'std_msgs/UInt32', 'layout': '<I',
                    'fields': ['data']},
        'winch': {'type': WINCH, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt16',
                  'layout': '>H', 'fields': ['data']}},
    'mcu/messages': {
        'cliff': {'type': CLIFF, 'ros_type': 'std_msgs/UInt32', 'layout': '<I',
                  'fields': ['data']}},
    'bus/functions': {
        'press': {'cmd2': PRESS, 'srv_type': 'serial_communication/Lift', 'timeout': 0.3,
                  'request': {'layout': '<2B', 'fields': ['direction', 'distance']}},
        'probe': {'cmd2': PROBE, 'srv_type': 'std_srvs/Trigger', 'timeout': 0.3,
                  'repeatable': True}}}
POLLED = {name: {'cmd2': cmd2, 'ros_type': 'std_msgs/UInt32', 'period': 0.1,
                 'reply': {'layout': '<I', 'fields': ['data']}}
          for name, cmd2 in (('depth', DEPTH), ('height', HEIGHT))}


class Sent(NamedTuple):
    """A value that a board sent."""

    topic: str
    key: Any
    wall: float      # time.time() before it was written


class Packet(NamedTuple):
    """A packet that the bridge sent to the car."""

    t: float
    type: int
    data: bytes
    heartbeats: int      # received before it on this connection
    connection: int

    @property
    def number(self) -> int:
        layout = {codec.SPEED: '<h', codec.STEERING: '<H', WINCH: '>H'}[self.type]
        return struct.unpack(layout, self.data)[0]

    @property
    def is_stop(self) -> bool:
        return self.type == codec.SPEED and not self.number

    def since(self, other: 'Packet') -> float:
        """Seconds since the other packet, in heartbeats: at most one period too short."""
        return (self.heartbeats - other.heartbeats) * PERIOD


Key = Tuple[str, Any]     # a topic, and a value as robot.py converts it


def car_keys(frame: codec.Frame) -> List[Key]:
    """The topics and values that a packet of the car is published as."""
    topic, layout = {
        codec.TICKS: ('~ticks', '<B'), codec.STEERING_ANGLE: ('~steering_angle', '<H'),
        COUNTER: ('~counter', '<I'), codec.VOLTAGE: ('~voltage', '<f'),
        codec.IMU: ('~imu', '>11h')}.get(frame.type, ('', ''))
    if not topic or len(frame.data) != struct.calcsize(layout):
        return []
    values = struct.unpack(layout, frame.data)
    if frame.type == codec.IMU:
        return [('~imu', values[:10]), ('~imu/temperature', values[10])]
    if frame.type == codec.VOLTAGE:
        return [('~voltage', wire_number(values[0] * 1000))] if 0 <= values[0] <= 100 else []
    return [(topic, values[0])]


def sensor_keys(frame: codec.Frame) -> List[Key]:
    """The topics and values that a frame of the sensor board is published as."""
    if frame.type == CLIFF and len(frame.data) == 4:
        return [('mcu/cliff', struct.unpack('<I', frame.data)[0])]
    if frame.type != codec.SENSORS:
        return []
    one, two, yaw, pitch, roll = struct.unpack('<HHhhh', frame.data)
    angles = angles_key((yaw if yaw >= -18000 else yaw + 65536, pitch, roll))
    return [('mcu/status', (frame.number, one, two, angles)), ('mcu/range_1', range_key(one)),
            ('mcu/range_2', range_key(two))]


def reply_keys(frame: codec.Frame) -> List[Key]:
    """The topics and values that a reply on the bus may be published as."""
    if frame.type == codec.OK and len(frame.data) == 6:
        return [('~environment', struct.unpack('<HhH', frame.data))]
    if frame.type == codec.OK and len(frame.data) == 4:
        number = struct.unpack('<I', frame.data)[0]
        return [('~depth', number), ('~height', number)]
    return []


def wire_number(value: float) -> Any:
    """The integer on the wire for this value; the value itself if it is not close to one."""
    number = round(value) if math.isfinite(value) else 0
    return number if abs(value - number) < 0.02 else value


def angles_key(angles: Tuple) -> Any:
    """The angles, or None if one of them is unknown: then none of them is compared."""
    return None if {None, -32768, 32768} & set(angles) else angles


def range_key(millimetres: int) -> Any:
    """The range as REP 117 reports it: a number, or a word if it is out of range."""
    return ('timed out' if millimetres == 0xFFFF else 'near' if millimetres < 30
            else 'far' if millimetres > 2000 else millimetres)


class Board:
    """Records the values and the bytes that it sends, until `clear_records`."""

    received_frame_at: codec.FrameAt
    sent_frame_at: codec.FrameAt
    keys: Callable[[codec.Frame], List[Key]]

    def __init__(self, line: SerialLine) -> None:
        self.line = line
        self.connection = 0
        self.sent: List[Sent] = []
        self.written: List[bytes] = []      # valid and invalid frames
        self._reader = codec.Reader(self.received_frame_at)
        self.attach()

    def attach(self) -> None:
        self.line.on_bytes, self.line.on_unplugged = self._read, self.start_connection

    def _read(self, data: bytes, now: float) -> None:
        for frame in self._reader.feed(data, now):
            self.received(frame, now)

    def start_connection(self) -> None:
        self._reader.reset()
        self.connection += 1

    def clear_records(self) -> None:
        self.sent.clear()
        self.written.clear()

    def received(self, frame: codec.Frame, now: float) -> None:
        """Called for each frame from the bridge."""

    def write(self, data: bytes) -> bool:
        return self.line.write(data) and not self.written.append(data)

    def send(self, data: bytes) -> None:
        """Send a frame whose values have to be published."""
        wall = time.time()
        if self.write(data):
            self.sent += [Sent(*key, wall) for frame in codec.decode(data, self.sent_frame_at)[0]
                          for key in self.keys(frame)]


class Car(Board):
    """The model car."""

    received_frame_at = sent_frame_at = staticmethod(codec.arduino_at)
    keys = staticmethod(car_keys)

    def __init__(self, line: SerialLine) -> None:
        super().__init__(line)
        self.packets: List[Packet] = []          # without heartbeats
        self.heartbeats = 0                      # received on this connection
        self.heartbeat_times: Deque[float] = deque(maxlen=6000)
        self.first: Dict[int, Packet] = {}       # the first packet of each connection
        self.ended: List[int] = []               # heartbeats of each connection that has ended
        self.on_packet: Callable[[Packet], None] = self.packets.append
        self._number = 0

    def start_connection(self) -> None:
        super().start_connection()
        self.ended.append(self.heartbeats)
        self.heartbeats = 0
        self.heartbeat_times.clear()

    def received(self, frame: codec.Frame, now: float) -> None:
        packet = Packet(now, frame.type, frame.data, self.heartbeats, self.connection)
        self.first.setdefault(self.connection, packet)
        if frame.type == codec.HEARTBEAT:
            self.heartbeats += 1
            self.heartbeat_times.append(now)
        else:
            self.on_packet(packet)

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

    def measure(self) -> None:
        """Send one packet of each type, with the next number."""
        self._number = n = self._number + 1
        self.send(codec.arduino_packet(codec.TICKS, bytes((n % 256,))))
        self.send(codec.arduino_packet(codec.STEERING_ANGLE, struct.pack('<H', n % 1025)))
        self.send(codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', n % 90000 / 1000)))
        self.send(codec.arduino_packet(COUNTER, struct.pack('<I', n)))
        self.send(codec.arduino_packet(codec.IMU, struct.pack('>11h', *imu_values(n))))


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
    keys = staticmethod(sensor_keys)

    def __init__(self, line: SerialLine) -> None:
        super().__init__(line)
        self.seq = 0
        self._number = 0

    def frame(self, type_: int, payload: bytes) -> bytes:
        self.seq = (self.seq + 1) % 256
        return codec.mcu_frame(type_, self.seq, payload)

    def measure(self) -> None:
        """Send one status; its ranges and angles follow from its number."""
        self._number = n = self._number + 1
        ranges = n % 65535, 0xFFFF if n % 10 == 0 else n * 7 % 2500
        heading, pitch, roll = n * 37 % 36000, n % 9000 - 4500, -(n % 17000)
        wrapped = heading if heading <= 32767 else heading - 65536
        self.send(self.frame(codec.SENSORS, struct.pack('<HHhhh', *ranges, wrapped, pitch, roll)))

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


class Reaction(NamedTuple):
    """How a bus board reacts to a request."""

    replies: List[Tuple[float, bytes]] = []     # (delay in s, bytes)
    executes: bool = False


class BusBoard(Board):
    """The main control board. It executes each function immediately and replies OK.

    Attributes:
        react: if set, returns another reaction to a function; None: the usual one.
        in_step: False after a reset, until a SYNC.
    """

    received_frame_at = staticmethod(codec.request_at)
    sent_frame_at = staticmethod(codec.reply_at)
    keys = staticmethod(reply_keys)

    def __init__(self, line: SerialLine, clock: Clock) -> None:
        super().__init__(line)
        self.requests: List[Request] = []
        self.executed: 'Counter[Tuple[int, bytes]]' = Counter()
        self.react: Optional[Callable[[Request], Optional[Reaction]]] = None
        self.in_step = True
        self.readings = 0
        self.on_request: Callable[[Request], None] = self.requests.append
        self._clock = clock
        self._free_at = 0.0      # when the last delayed reply is written
        self._delayed: Deque[Tuple[int, bytes]] = deque()

    def received(self, frame: codec.Frame, now: float) -> None:
        request = Request(now, *frame.content, self.connection)
        self.on_request(request)
        reaction = self._reaction(request)
        if reaction.executes:
            self.executed[request.key] += 1
        for seconds, reply in reaction.replies:
            self._write_in_order(seconds, reply)

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
        self._free_at = 0.0

    def clear_records(self) -> None:
        super().clear_records()
        self.requests.clear()
        self.executed.clear()

    def _reaction(self, request: Request) -> Reaction:
        if request.cmd1 == codec.SYNC:
            self.in_step = True
            return Reaction([(0, reply_frame(codec.SYNC))])
        if not self.in_step:
            return Reaction([(0, reply_frame(codec.INVALID, bytes((codec.NOT_SYNCHRONISED,))))])
        if request.cmd1 == codec.ECHO:
            return Reaction([(0, reply_frame(codec.ECHO, request.data))])
        other = self.react(request) if self.react else None
        return other or Reaction([(0, self.ok_reply(request))], True)

    def ok_reply(self, request: Request) -> bytes:
        if request.cmd2 == codec.ENVIRONMENT:
            self.readings = n = self.readings + 1
            values = n % 65536, n % 20000 - 4000, n % 10001
            self.sent.append(Sent('~environment', values, time.time()))
            return reply_frame(codec.OK, struct.pack('<HhH', *values))
        if request.cmd2 in (DEPTH, HEIGHT):     # the depth is always even, the height odd
            self.readings += 1
            n = 2 * self.readings + (request.cmd2 == HEIGHT)
            self.sent.append(Sent('~depth' if request.cmd2 == DEPTH else '~height', n, time.time()))
            return reply_frame(codec.OK, struct.pack('<I', n))
        return reply_frame(codec.OK, request.data if request.cmd2 == MEMORY else b'')


def reply_frame(cmd1: int, data: bytes = b'') -> bytes:
    return codec.bus_frame(bytes((cmd1,)), data)
