"""The computer's end of each emulated board's link. Its waits are in emulated time."""

import math
import struct
from contextlib import contextmanager

import pytest
import serial
from by_definition import (SENSORS, arduino_at, arduino_packet, bus_frame, mcu_at,
                           xor_of)
from emulated_board import EmulatedBoard

(DEBUG, INFO, WARN, ERROR, SPEED, STEERING, LED, ANGLE, TICKS, IMU, VOLTAGE, HEARTBEAT,
 CALIBRATION) = range(13)
TIME, MCU_TIME = 254, 0xFE
SETTING, MCU_SETTING, MCU_CHUNK = 253, 0xFD, 0xFF
FORCE, GRIPPER = 32, 48    # custom messages
ODOM, CMD_VEL = 40, 41     # those of the example DiffDrive
PUMP, TANK = 0x30, 0x32    # custom functions of the bus
RATE_SCALE = 4000.0 / 65536 * math.pi / 180 * 25  # rad/s
ACCELERATION_SCALE = 8.0 / 65536 * 9.81  # m/s^2


def open_port(board):
    return serial.Serial(board.port, 115200, timeout=0)


# The model car


# Of the packets with data of one length, for telling those that a reset has cut off.
LENGTHS = {ANGLE: 2, TICKS: 1, IMU: 22, VOLTAGE: 4, ODOM: 20, TIME: 5}


packet = arduino_packet


def driving(speed):
    """A heartbeat and a speed command."""
    return packet(HEARTBEAT) + packet(SPEED, struct.pack('<h', speed))


class Car:
    """The computer's end of the car's link; collects every packet from the board's start on."""

    def __init__(self, board):
        self.board = board
        self.port = open_port(board)
        self.packets = []
        # Opening the port drops what was sent before, in the middle of a packet.
        board.reset()
        self._rest = b''
        board.wait_until(lambda: b'\x00' in self._receive(), 1)
        self._rest = self._rest.split(b'\x00', 1)[1]

    def _receive(self):
        self._rest += self.port.read(4096)
        return self._rest

    def send(self, kind, data=b''):
        self.port.write(packet(kind, data))

    def drive(self, speed):
        """To be repeated, as a driver does."""
        self.port.write(driving(speed))

    def read(self, kind=None):
        """Takes in what has arrived; returns the data of all packets of that kind so far."""
        frames = self._receive().split(b'\x00')
        self._rest = frames.pop()
        for frame in frames:
            found = arduino_at(frame + b'\x00', 0)
            if found and len(found.data) == LENGTHS.get(found.type, len(found.data)):
                self.packets.append((found.type, found.data))
        return [data for packet_kind, data in self.packets if packet_kind == kind]

    def forget(self):
        self.read()
        self.packets = []

    def next(self, kind, count=1, seconds=5):
        """The data of the next packets of that kind."""
        self.forget()
        self.board.wait_until(lambda: len(self.read(kind)) >= count, seconds)
        return self.read(kind)[:count]

    def texts(self):
        return [(kind, data.rstrip(b'\x00').decode('ascii', 'replace'))
                for kind, data in self.packets if kind <= ERROR]

    def wait_for_text(self, text, seconds=5):
        def arrived():
            self.read()
            return any(text in logged for _, logged in self.texts())

        self.board.wait_until(arrived, seconds)

    def orientation(self):
        return imu_values(self.next(IMU)[0])[0]


def imu_values(data):
    """Orientation (w, x, y, z), rates, accelerations, temperature; in ROS's axes and units."""
    fields = struct.unpack('>11h', data)
    w, x, y, z = [value / 16384.0 for value in fields[:4]]
    rates = [value * RATE_SCALE for value in fields[4:7]]
    accelerations = [value * ACCELERATION_SCALE for value in fields[7:10]]
    return ((w,) + to_ros((x, y, z)), to_ros(rates), to_ros(accelerations),
            fields[10] / 340.0 + 36.53)


def to_ros(vector):
    """The board's axes into ROS's."""
    return vector[1], -vector[0], vector[2]


def from_euler(yaw, pitch, roll):
    """The quaternion of these angles in degrees, in ROS's order."""
    cy, sy = math.cos(math.radians(yaw) / 2), math.sin(math.radians(yaw) / 2)
    cp, sp = math.cos(math.radians(pitch) / 2), math.sin(math.radians(pitch) / 2)
    cr, sr = math.cos(math.radians(roll) / 2), math.sin(math.radians(roll) / 2)
    return (cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy)


def angle_between(a, b):
    """Degrees between two orientations."""
    dot = abs(sum(p * q for p, q in zip(a, b)))
    norm = math.sqrt(sum(p * p for p in a) * sum(q * q for q in b))
    return math.degrees(2 * math.acos(min(1.0, dot / norm)))


def drive_until(car, speed, condition, seconds=5):
    def step():
        car.drive(speed)
        car.read()
        return condition()

    car.board.wait_until(step, seconds)


def board_times(packets):
    """The times in s of the board's clock that are among these packets of the car."""
    return [struct.unpack('<I', data[:4])[0] * 1e-6 for kind, data in packets if kind == TIME]


def comes_at(car, kind, rate):
    """Whether so many packets of that kind come in a second of the board's clock, within 5 %."""
    car.next(kind, rate + 1)
    kinds = [each for each, _ in car.packets]
    first, last = kinds.index(TIME), len(kinds) - 1 - kinds[::-1].index(TIME)
    times = board_times(car.packets)
    return kinds[first:last].count(kind) / (times[-1] - times[0]) == pytest.approx(rate, rel=0.05)


# The control board

SYNC = bytes.fromhex('a5000000a5')
LIFT, GIMBAL, ENVIRONMENT = 0x20, 0x21, 0x22
UP, DOWN = 0, 1
OK = b'\x02'


def request(cmd1, cmd2=0, data=b''):
    return bus_frame(bytes([cmd1, cmd2]), data)


class Master:
    """The computer's end of the bus; a reply is returned as CMD1 and DATE."""

    def __init__(self, board):
        self.board = board
        self.port = open_port(board)
        self._received = b''

    def write(self, data):
        self.port.write(data)

    def has_reply(self):
        self._received += self.port.read(4096)
        return self._size() is not None

    def reply(self, seconds=1):
        self.board.wait_until(self.has_reply, seconds)
        size = self._size()
        frame, self._received = self._received[:size], self._received[size:]
        assert xor_of(frame) == 0, frame.hex()
        return frame[2 if frame[0] == 0xA5 else 3:-1]

    def _size(self):
        data = self._received
        if len(data) < 3:
            return None
        assert data[0] in (0xA5, 0x5A), data.hex()
        size = data[1] + 4 if data[0] == 0xA5 else struct.unpack_from('<H', data, 1)[0] + 5
        return size if len(data) >= size else None

    def ask(self, cmd1, cmd2=0, data=b'', seconds=1):
        self.write(request(cmd1, cmd2, data))
        return self.reply(seconds)

    def function(self, cmd2, data=b'', seconds=5):
        return self.ask(0x55, cmd2, data, seconds)

    def sync(self):
        assert self.ask(0) == b'\x00'

    def forget(self):
        """Drops what has arrived, and returns it."""
        received, self._received = self._received + self.port.read(4096), b''
        return received

    def silence(self, seconds):
        """Nothing arrives for so long."""
        self.board.run_for(seconds)
        self._received += self.port.read(4096)
        assert self._received == b''


def error(code):
    return b'\x03' + struct.pack('<H', code)


# The sensor board


class Frames:
    """Sensor status frames from the board, each behind its time, and its settings."""

    def __init__(self, board):
        self.board = board
        self.port = open_port(board)
        self._received = b''
        self._cut = True     # opening the port drops what is there
        self.frames = []
        self.times = []      # (number, µs)
        self.settings = []   # data
        self.numbers = []    # of all frames

    def read(self):
        self._received += self.port.read(4096)
        if self._cut:
            start = self._received.find(b'\x02\x06\xfe')
            if start < 0:
                return self.frames
            self._received = self._received[start:]
            self._cut = False
        while len(self._received) > 1 and len(self._received) >= self._received[1] + 4:
            size = self._received[1] + 4
            frame, self._received = self._received[:size], self._received[size:]
            found = mcu_at(frame, 0)
            assert found and found.type in (SENSORS, MCU_TIME, MCU_SETTING, MCU_CHUNK), frame.hex()
            self.numbers.append(found.number)
            if found.type == SENSORS:
                self.frames.append((found.number,) + struct.unpack('<HHhhh', found.data))
            elif found.type == MCU_TIME:
                self.times.append((found.number, *struct.unpack('<I', found.data)))
            elif found.type == MCU_SETTING:
                self.settings.append(found.data)
        return self.frames

    def forget_a_cut_frame(self):
        """After a reset: what is left of the frame under way, and what is here of a new one."""
        start = self.board.time
        self.board.wait_until(lambda: self.board.time > start + 0.02, 1)
        self.port.read(4096)
        self._received = b''
        self._cut = True

    def next(self, count=1):
        self.read()
        self.frames = []
        self.board.wait_until(lambda: len(self.read()) >= count, 1 + count / 10.0)
        return self.frames[:count]


# An emulated board and the computer's end of its link, until the end of a block. `options` are
# those of EmulatedBoard.


@contextmanager
def _end_of(make, build, world, **options):
    with EmulatedBoard(build, world, **options) as board:
        if world == 'ctrl':
            board.wait_until(lambda: board.time > 0.05, 1)
        end = make(board)
        yield end
        end.port.close()


def car_end(build, **options):
    return _end_of(Car, build, 'car', **options)


def master_end(build, **options):
    return _end_of(Master, build, 'ctrl', **options)


def frames_end(build, **options):
    return _end_of(Frames, build, 'range', **options)
