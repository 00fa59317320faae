"""The three boards at the far ends of the lines. They keep what they were told and what they said.
Everything a board says has a running number: each published value tells which frame it came of."""
import math
import struct
import time
from collections import Counter, deque
from typing import Any, Callable, Deque, Dict, List, NamedTuple, Optional, Tuple

import by_definition as codec
from .lines import Clock, Line

BEAT = 0.01              # s from one heartbeat to the next: the bridge's own clock on the line
COUNTER, WINCH = 60, 62  # custom messages of the car: a number up, a command
CLIFF = 0x20             # of the sensor board
PRESS, PROBE, DEPTH, HEIGHT = 0x60, 0x61, 0x70, 0x71     # functions of the bus board
MEMORY = 0xF0            # a function of the bus board that only raw requests ask for
CUSTOM: Dict[str, Dict[str, Any]] = {    # parameters of the bridge for all of these
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
    """A value that left a board."""

    topic: str
    key: Any
    wall: float      # time.time() before it was written


class Packet(NamedTuple):
    """One that the bridge wrote to the car."""

    t: float
    type: int
    data: bytes
    beat: int        # heartbeats on this connection before it
    connection: int

    @property
    def number(self) -> int:
        layout = {codec.SPEED: '<h', codec.STEERING: '<H', WINCH: '>H'}[self.type]
        return struct.unpack(layout, self.data)[0]

    @property
    def stops(self) -> bool:
        """Whether it is SPEED 0."""
        return self.type == codec.SPEED and not self.number

    def since(self, other: 'Packet') -> float:
        """s from that one, by heartbeats: no less, but for one that was due with it."""
        return (self.beat - other.beat) * BEAT


Key = Tuple[str, Any]     # a topic, and a value of it as robot.py has it


def car_keys(frame: codec.Frame) -> List[Key]:
    """What a packet of the car is published as."""
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
        return [('~voltage', whole(values[0] * 1000))] if 0 <= values[0] <= 100 else []
    return [(topic, values[0])]


def sensor_keys(frame: codec.Frame) -> List[Key]:
    """What a frame of the sensor board is published as."""
    if frame.type == CLIFF and len(frame.data) == 4:
        return [('mcu/cliff', struct.unpack('<I', frame.data)[0])]
    if frame.type != codec.SENSORS:
        return []
    one, two, yaw, pitch, roll = struct.unpack('<HHhhh', frame.data)
    angles = known((yaw if yaw >= -18000 else yaw + 65536, pitch, roll))
    return [('mcu/status', (frame.command, one, two, angles)), ('mcu/range_1', range_of(one)),
            ('mcu/range_2', range_of(two))]


def reply_keys(frame: codec.Frame) -> List[Key]:
    """What a reply on the bus may be published as."""
    if frame.type == codec.OK and len(frame.data) == 6:
        return [('~environment', struct.unpack('<HhH', frame.data))]
    if frame.type == codec.OK and len(frame.data) == 4:
        number = struct.unpack('<I', frame.data)[0]
        return [('~depth', number), ('~height', number)]
    return []


def whole(value: float) -> Any:
    """The number on the wire that this is; the value itself where it is none."""
    number = round(value) if math.isfinite(value) else 0
    return number if abs(value - number) < 0.02 else value


def known(angles: Tuple) -> Any:
    """None where one says that it is not known: what is published then is not asked."""
    return None if {None, -32768, 32768} & set(angles) else angles


def range_of(millimetres: int) -> Any:
    """What REP 117 makes of it: the number, or a word."""
    return ('timed out' if millimetres == 0xFFFF else 'near' if millimetres < 30
            else 'far' if millimetres > 2000 else millimetres)


class Board:
    """Keeps what it sent, by topic."""

    frame_at: codec.FrameAt      # of what it is told
    says_at: codec.FrameAt       # of what it says
    keys: Callable[[codec.Frame], List[Key]]

    def __init__(self, line: Line) -> None:
        self.line = line
        self.connection = 0
        self.sent: List[Sent] = []
        self.said: List[bytes] = []      # frames, and what is none, since `forget`
        self._reader = codec.Reader(self.frame_at)
        self.attach()

    def attach(self) -> None:
        self.line.take, self.line.cut = self._take, self.open_anew

    def _take(self, data: bytes, now: float) -> None:
        for frame in self._reader.feed(data, now):
            self.received(frame, now)

    def open_anew(self) -> None:
        self._reader.reset()
        self.connection += 1

    def forget(self) -> None:
        self.sent.clear()
        self.said.clear()

    def received(self, frame: codec.Frame, now: float) -> None:
        """A frame of the bridge's."""

    def write(self, data: bytes) -> bool:
        return self.line.write(data) and not self.said.append(data)

    def say(self, data: bytes) -> None:
        """Send a frame whose values are to be published."""
        wall = time.time()
        if self.write(data):
            self.sent += [Sent(*key, wall) for frame in codec.decode(data, self.says_at)[0]
                          for key in self.keys(frame)]


class Car(Board):
    """The model car."""

    frame_at = says_at = staticmethod(codec.arduino_at)
    keys = staticmethod(car_keys)

    def __init__(self, line: Line) -> None:
        super().__init__(line)
        self.packets: List[Packet] = []          # all but heartbeats
        self.beats: Deque[float] = deque(maxlen=6000)      # when heartbeats were read
        self.beat = 0                            # on this connection
        self.first: Dict[int, Packet] = {}       # of each connection
        self.ended: List[int] = []               # heartbeats of each connection that has ended
        self.on_packet: Callable[[Packet], None] = self.packets.append
        self._number = 0

    def open_anew(self) -> None:
        super().open_anew()
        self.ended.append(self.beat)
        self.beat = 0
        self.beats.clear()

    def received(self, frame: codec.Frame, now: float) -> None:
        packet = Packet(now, frame.type, frame.data, self.beat, self.connection)
        self.first.setdefault(self.connection, packet)
        if frame.type == codec.HEARTBEAT:
            self.beat += 1
            self.beats.append(now)
        else:
            self.on_packet(packet)

    def forget(self) -> None:
        super().forget()
        self.packets.clear()

    def commands(self, type_: int, since: int = 0) -> List[int]:
        return [packet.number for packet in self.packets[since:] if packet.type == type_]

    def packet(self, type_: int, value: int, since: int = 0) -> Optional[Packet]:
        return next((packet for packet in self.packets[since:]
                     if packet.type == type_ and packet.number == value), None)

    def zero_after(self, packet: Packet) -> Optional[Packet]:
        """The first SPEED 0 behind this one."""
        at = self.packets.index(packet)
        return next((one for one in self.packets[at + 1:] if one.stops), None)

    def measure(self) -> None:
        self._number = n = self._number + 1
        self.say(codec.arduino_packet(codec.TICKS, bytes((n % 256,))))
        self.say(codec.arduino_packet(codec.STEERING_ANGLE, struct.pack('<H', n % 1025)))
        self.say(codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', n % 90000 / 1000)))
        self.say(codec.arduino_packet(COUNTER, struct.pack('<I', n)))
        self.say(codec.arduino_packet(codec.IMU, struct.pack('>11h', *imu_of(n))))


def imu_of(n: int) -> Tuple[int, ...]:
    """The eleven numbers of an IMU packet, in the board's axes: a turning quaternion of norm 1."""
    angle = n % 3600 / 3600 * math.pi
    about = 1 + n % 3
    quaternion = [round(16384 * math.cos(angle)), 0, 0, 0]
    quaternion[about] = round(16384 * math.sin(angle))
    return (*quaternion, n % 30000, -(n % 30011), n % 7, n * 3 % 20011, -(n % 8192), 8192 - n % 99,
            n % 30000 - 15000)


class Sensors(Board):
    """The sensor board."""

    frame_at = says_at = staticmethod(codec.mcu_at)
    keys = staticmethod(sensor_keys)

    def __init__(self, line: Line) -> None:
        super().__init__(line)
        self.seq = 0
        self._number = 0

    def frame(self, type_: int, payload: bytes) -> bytes:
        self.seq = (self.seq + 1) % 256
        return codec.mcu_frame(type_, self.seq, payload)

    def measure(self) -> None:
        """One status; its ranges and angles tell its number."""
        self._number = n = self._number + 1
        ranges = n % 65535, 0xFFFF if n % 10 == 0 else n * 7 % 2500
        heading, pitch, roll = n * 37 % 36000, n % 9000 - 4500, -(n % 17000)
        wrapped = heading if heading <= 32767 else heading - 65536
        self.say(self.frame(codec.SENSORS, struct.pack('<HHhhh', *ranges, wrapped, pitch, roll)))

    def cliff(self) -> None:
        self._number = n = self._number + 1
        self.say(self.frame(CLIFF, struct.pack('<I', n)))


class Request(NamedTuple):
    """One that reached the bus board."""

    t: float
    cmd1: int
    cmd2: int
    data: bytes
    connection: int

    @property
    def key(self) -> Tuple[int, bytes]:
        return self.cmd2, self.data


class Answer(NamedTuple):
    """What a bus board makes of a request."""

    replies: List[Tuple[float, bytes]] = []     # (seconds from now, bytes)
    executes: bool = False


class BusBoard(Board):
    """The main control board. It executes a function at once and answers OK with data that tells
    whose it is.

    Attributes:
        rule: what it does with a function instead; None: as always.
        in_step: False after a reset: it asks for SYNC.
    """

    frame_at = staticmethod(codec.request_at)
    says_at = staticmethod(codec.reply_at)
    keys = staticmethod(reply_keys)

    def __init__(self, line: Line, clock: Clock) -> None:
        super().__init__(line)
        self.requests: List[Request] = []
        self.executed: 'Counter[Tuple[int, bytes]]' = Counter()
        self.rule: Optional[Callable[[Request], Optional[Answer]]] = None
        self.in_step = True
        self.readings = 0
        self.on_request: Callable[[Request], None] = self.requests.append
        self._clock = clock
        self._free_at = 0.0      # when all replies so far have left
        self._late: Deque[Tuple[int, bytes]] = deque()

    def received(self, frame: codec.Frame, now: float) -> None:
        request = Request(now, *frame.content, self.connection)
        self.on_request(request)
        answer = self._answer(request)
        if answer.executes:
            self.executed[request.key] += 1
        for seconds, reply in answer.replies:
            self._write_in_order(seconds, reply)

    def _write_in_order(self, seconds: float, reply: bytes) -> None:
        """A line keeps its order: what is late, or comes twice, makes all behind it late."""
        now = time.monotonic()
        self._free_at = max(now + seconds, self._free_at)
        if self._free_at <= now and not self._late:
            self.write(reply)
        else:
            self._late.append((self.connection, reply))
            self._clock.at(self._free_at, self._write_late)

    def _write_late(self) -> None:
        connection, reply = self._late[0]
        if self.connection == connection:
            self.write(reply)
        self._late.popleft()

    def open_anew(self) -> None:
        super().open_anew()
        self._free_at = 0.0

    def forget(self) -> None:
        super().forget()
        self.requests.clear()
        self.executed.clear()

    def _answer(self, request: Request) -> Answer:
        if request.cmd1 == codec.SYNC:
            self.in_step = True
            return Answer([(0, reply(codec.SYNC))])
        if not self.in_step:
            return Answer([(0, reply(codec.INVALID, bytes((codec.NOT_SYNCHRONISED,))))])
        if request.cmd1 == codec.ECHO:
            return Answer([(0, reply(codec.ECHO, request.data))])
        special = self.rule(request) if self.rule else None
        return special or Answer([(0, self.ok(request))], True)

    def ok(self, request: Request) -> bytes:
        if request.cmd2 == codec.ENVIRONMENT:
            self.readings = n = self.readings + 1
            values = n % 65536, n % 20000 - 4000, n % 10001
            self.sent.append(Sent('~environment', values, time.time()))
            return reply(codec.OK, struct.pack('<HhH', *values))
        if request.cmd2 in (DEPTH, HEIGHT):     # one has the even numbers, the other the odd
            self.readings += 1
            n = 2 * self.readings + (request.cmd2 == HEIGHT)
            self.sent.append(Sent('~depth' if request.cmd2 == DEPTH else '~height', n, time.time()))
            return reply(codec.OK, struct.pack('<I', n))
        return reply(codec.OK, request.data if request.cmd2 == MEMORY else b'')


def reply(cmd1: int, data: bytes = b'') -> bytes:
    return codec.bus_frame(bytes((cmd1,)), data)
