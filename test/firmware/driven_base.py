"""The computer's end of the example DiffDrive in its world: drives by packets, reads odometry."""
import math
import struct
from contextlib import contextmanager
from typing import NamedTuple

from board_ends import CMD_VEL, ERROR, HEARTBEAT, ODOM, Car, packet
from emulated_board import EmulatedBoard

AHEAD = 600               # bytes on the line, 0.05 s
ALONG, ROUND = 0.3, 1.2   # m/s and rad/s of a square


class Pose(NamedTuple):
    """Where the base is: m, and rad, which also counts whole turns."""

    x: float
    y: float
    yaw: float


def cmd_vel(ahead, turn):
    """A command, in m/s and rad/s."""
    return packet(CMD_VEL, struct.pack('<hh', round(ahead * 1000), round(turn * 1000)))


class Base(Car):
    """Its link, which is kept full of heartbeats while it is driven.

    `odometry` has the values of the latest message: x, y, yaw, ahead, turn; `new` has all messages
    of the latest update.
    """

    def __init__(self, board):
        super().__init__(board)
        self.odometry = ()
        self.new = []
        self._sent = -int(board.get('rx_bytes'))     # bytes, since this began

    def update(self):
        """Read what has arrived; texts are kept."""
        self.new = [struct.unpack('<5f', data) for data in self.read(ODOM)]
        if self.new:
            self.odometry = self.new[-1]
        self.packets = [(kind, data) for kind, data in self.packets if kind <= ERROR]
        return self.odometry

    def write(self, data):
        """Send bytes; return their number since the start."""
        self.port.write(data)
        self._sent += len(data)
        return self._sent

    def beat(self, command=b''):
        """Send a command, and heartbeats until the line has enough to do; and read."""
        room = AHEAD - (self._sent - self.board.get('rx_bytes'))
        if room > 0:
            self.write(command + packet(HEARTBEAT) * int(room / len(packet(HEARTBEAT)) + 1))
        self.update()

    def drive(self, ahead, turn=0.0):
        """Send a command for as long as heartbeats are sent, and read."""
        self.beat(cmd_vel(ahead, turn))

    def beat_until(self, condition, seconds):
        """Wait for a condition that sends heartbeats; the board's clock stands until they come."""
        self.board.set('line_first', 1)
        try:
            self.board.wait_until(condition, seconds)
        finally:
            self.board.set('line_first', 0)

    def drive_until(self, condition, ahead, turn=0.0, seconds=10):
        """Send a command, and repeat it until a condition holds."""
        def step():
            self.drive(ahead, turn)
            return condition()
        self.write(cmd_vel(ahead, turn))     # even if the line has enough to do
        self.beat_until(step, seconds)

    def truth(self):
        """Where the base is in its world."""
        x, y, yaw = self.board.at_once('x', 'y', 'yaw')
        return Pose(x, y, math.radians(yaw))

    def believed(self):
        """Where the odometry has it."""
        return Pose(*self.odometry[:3])

    def stand(self):
        """Stop, and wait for the odometry of standing."""
        self.drive_until(lambda: self.odometry[3:] == (0.0, 0.0) and not any(
            abs(self.board.get(wheel + '_speed')) > 1e-6 for wheel in ('left', 'right')), 0.0)
        self.forget()
        self.board.wait_until(lambda: len(self.read(ODOM)) > 1, 2)
        self.update()

    def drive_square(self, side, seen=lambda: None):
        """Drive a square to the left by the odometry, as a program on the computer would.

        `seen` is called after each message of odometry.
        """
        for number in range(4):
            begin = self.believed()
            self._approach(lambda begin=begin: side - math.hypot(
                self.odometry[0] - begin.x, self.odometry[1] - begin.y), ALONG, 0.0, seen)
            wanted = (number + 1) * math.pi / 2
            self._approach(lambda wanted=wanted: math.remainder(
                wanted - self.odometry[2], 2 * math.pi), 0.0, ROUND, seen)

    def _approach(self, left, ahead, turn, seen):
        """Drive until `left()` is 0, slower and slower at the end."""
        last = ()

        def arrived():
            nonlocal last
            rest = left()
            share = min(1.0, max(0.1, 3 * rest))
            self.drive(ahead * share, turn * share)
            if self.odometry != last:
                last = self.odometry
                seen()
            return rest <= 0
        self.beat_until(arrived, 60)
        self.stand()


@contextmanager
def base_end(build):
    """The emulated base, until the end of a block; its odometry has begun."""
    with EmulatedBoard(build, 'diff') as board:
        base = Base(board)
        board.wait_until(base.update, 2)
        yield base
        base.port.close()
