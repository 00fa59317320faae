"""Angles to quaternions, and back."""
from math import atan2, cos, hypot, sin
from typing import Tuple


def quaternion(roll: float, pitch: float, yaw: float) -> Tuple[float, float, float, float]:
    """The quaternion (x, y, z, w) of rotations about the fixed axes x, y and z, in that order.

    Angles are in radians.
    """
    cr, sr = cos(roll / 2), sin(roll / 2)
    cp, sp = cos(pitch / 2), sin(pitch / 2)
    cy, sy = cos(yaw / 2), sin(yaw / 2)
    return (sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy)


def angles(x: float, y: float, z: float, w: float) -> Tuple[float, float, float]:
    """The roll, pitch and yaw, in radians, of a quaternion of any length; 0 for (0, 0, 0, 0)."""
    forward = w * w + x * x - y * y - z * z, 2 * (x * y + w * z)
    return (atan2(2 * (y * z + w * x), w * w - x * x - y * y + z * z),
            atan2(2 * (w * y - x * z), hypot(*forward)), atan2(forward[1], forward[0]))
