"""Angles to quaternions."""
from math import cos, sin
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
