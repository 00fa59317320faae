"""What all promises share: their form, the numbers of the protocols, and what a story gives."""
import struct
from typing import Dict, Iterator, List, Tuple

from evidence import At, Evidence

# Yielded by a promise: how often it was at stake, and what broke it; '': nothing.
Verdicts = Iterator[Tuple[int, str]]
SPEED, STEERING, LED, IMU, HEARTBEAT, CALIBRATION = 4, 5, 6, 9, 11, 12
FORCE, GRIPPER, DRIVE, SETTING, TIME, ANNOUNCEMENT = 32, 33, 34, 253, 254, 255
SYNC, ECHO, OK, FUNCTION, INVALID = 0x00, 0x01, 0x02, 0x55, 0xFF
LIFT, GIMBAL, ENVIRONMENT, HALT, PRESS, LEVEL, RAW = 0x20, 0x21, 0x22, 0x2F, 0x30, 0x31, 0xF0
MOVES = LIFT, GIMBAL, PRESS, RAW
SLACK = 0.005           # s; a loop of an idle computer runs a little after it is due
FRESH = 0.5             # s after a stall
STALL = 0.19            # s; what is longer may count as a stall: a loop may have slept before
TIMEOUT = 0.5           # s; arduino/speed_timeout


def speed_of(frame: At) -> int:
    """The value of a SPEED_CMD."""
    return struct.unpack('<h', frame.data)[0] if len(frame.data) == 2 else 0


def is_zero(frame: At) -> bool:
    """Whether it ends a motion, or would."""
    return frame.type in (SPEED, DRIVE) and not any(frame.data)


def speeds(e: Evidence) -> List[At]:
    """The SPEED_CMDs that were written."""
    return e.of_type(e.wrote, SPEED)


def executed_by(e: Evidence) -> Dict[Tuple[int, int, bytes], List[float]]:
    """When the board of the bus executed each request."""
    found: Dict[Tuple[int, int, bytes], List[float]] = {}
    for time, event, fields in e.story.far.notes:
        if event == 'executed':
            key = fields['cmd1'], fields['cmd2'], bytes.fromhex(fields['data'])
            found.setdefault(key, []).append(time)
    return found


def told(called) -> str:
    """What a caller was told."""
    word = called.told.word if called.told else 'nothing'
    return 'refused' if word in ('failed', 'not sent') else word
