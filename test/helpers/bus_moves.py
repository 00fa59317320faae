"""Moves of the control board."""
from serial_communication.boards.bus import wire as bus


def lift(direction, distance):
    """A move of the lift."""
    return bus.LIFT_FUNCTION.make_request((direction, distance))


def gimbal(direction, angle):
    """A turn of the gimbal."""
    return bus.GIMBAL_FUNCTION.make_request((direction, angle))
