"""A simulated wind sensor: the wind turns by 6 degrees a second at 5 m/s."""
from serial_communication.simulation.board import Board
from serial_communication.transport.pace import Every

from . import DESCRIPTION
from .wire import Wind, encode


class WindSensor(Board):
    """See the module."""

    NAME = DESCRIPTION.name
    SUMMARY = 'wind sensor: NMEA 0183'
    FAULTS = 'drop=0.01 cut=0.01 flip=0.01 insert=0.01 silence=0.5/min'
    READS = False

    def power_on(self, now: float) -> None:
        self._start = now
        self._beat = Every(0.2, now)

    def advance(self, now: float):
        if self._beat.passed(now):
            self.line.send(encode(Wind((now - self._start) * 6 % 360, 5.0)))
        return self._beat.due


BOARD = WindSensor
