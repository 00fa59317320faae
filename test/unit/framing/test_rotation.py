"""Angles to quaternions and back."""
import math

import pytest

from serial_communication.framing.rotation import angles, quaternion

HALF = math.sqrt(0.5)


@pytest.mark.parametrize('given, expected', [
    ((0, 0, math.pi / 2), (0, 0, HALF, HALF)), ((math.pi / 2, 0, 0), (HALF, 0, 0, HALF)),
    ((0, math.pi / 2, 0), (0, HALF, 0, HALF)), ((0, 0, -math.pi), (0, 0, -1, 0))])
def test_quaternions_of_single_rotations(given, expected):
    assert quaternion(*given) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize('given', [
    (0, 0, 3.1), (0, 0, -3.1), (0.5, -1.2, 2.8), (-3, 1.5, -0.1), (1, 0, 0), (0, -1.57, 0)])
@pytest.mark.parametrize('length', [1, 0.01, 300])
def test_angles_come_back_from_a_quaternion_of_any_length(given, length):
    back = angles(*[length * part for part in quaternion(*given)])
    assert back == pytest.approx(given, abs=1e-9)


def test_the_angles_of_an_empty_message_are_0():
    assert angles(0, 0, 0, 0) == (0, 0, 0)
