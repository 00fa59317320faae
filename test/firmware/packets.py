"""What the computer sends to the emulated boards, and the numbers of what they send."""
import struct

from by_definition import (FUNCTION, GIMBAL, LIFT, SPEED, STEERING, arduino_packet, bus_frame)
from by_definition import HEARTBEAT as HEARTBEAT_TYPE

FORCE, GRIPPER = 32, 48         # of nano_car_custom
TARGET, WHEEL_SPEED = 32, 33    # of Tuning
ODOM, CMD_VEL = 40, 41          # of DiffDrive
PUMP, TANK, DOOR, STOP = 0x30, 0x32, 0x33, 0x2F
UP, DOWN = 0, 1
LEFT, RIGHT, TILT_UP, TILT_DOWN = range(4)

HEARTBEAT = arduino_packet(HEARTBEAT_TYPE)


def speed(value):
    return arduino_packet(SPEED, struct.pack('<h', value))


def steering(pulse):
    return arduino_packet(STEERING, struct.pack('<H', pulse))


def gripper(position, force):
    return arduino_packet(GRIPPER, struct.pack('<hB', position, force))


def target(turns):
    return arduino_packet(TARGET, struct.pack('<f', turns))


def cmd_vel(ahead, turn=0.0):
    """Of m/s and rad/s."""
    return arduino_packet(CMD_VEL, struct.pack('<hh', round(1000 * ahead), round(1000 * turn)))


def request(cmd1, cmd2=0, data=b''):
    return bus_frame(bytes((cmd1, cmd2)), data)


def function(cmd2, *data):
    return request(FUNCTION, cmd2, bytes(data))


def lift(direction, distance):
    return function(LIFT, direction, distance)


def gimbal(direction, degrees):
    return function(GIMBAL, direction, degrees)


# Replies, as Board.reply() has them.
OK, UNSUPPORTED, MALFORMED, FAILED = b'\x02', b'\x03\0\x80', b'\x03\x01\x80', b'\x03\x02\x80'
