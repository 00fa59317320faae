"""The picture of a square that the emulated base drove, and of its odometry."""
import itertools
import math
import struct
import sys
from pathlib import Path
from typing import NamedTuple

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / part) for part in ('firmware', 'helpers')]

from emulated_board import Booted, build_firmware  # noqa: E402
from packets import HEARTBEAT, ODOM, cmd_vel  # noqa: E402

SIDE = 1.0          # m
WRONG = 1.03        # factor of a track that was measured badly
_SCALE = 340        # pixels per m
_LEFT, _TOP, _WIDTH, _HEIGHT = 150, 470, 860, 530
_STYLE = '''text { font: 15px "DejaVu Sans", sans-serif; fill: #333 }
.title { font-size: 17px; font-weight: bold } path { fill: none }
.true { stroke: #9fc5d8; stroke-width: 9 } .told { stroke: #00506b; stroke-width: 2 }
.wrong { stroke: #d1495b; stroke-width: 2; stroke-dasharray: 7 5 } line { stroke: #ddd }'''


class Pose(NamedTuple):
    """Where the base is: m, and rad."""

    x: float
    y: float
    yaw: float


class Drive:
    """The emulated base, driven by its odometry as a program on the computer would."""

    def __init__(self, board):
        self._board = board
        self.true, self.told = [], []      # where it was, and where its odometry had it

    def until(self, left, ahead, turn):
        """Drive until `left(pose)` is 0, slower and slower at the end; and stop."""
        rest = 1.0
        while rest > 0:
            share = min(1.0, max(0.1, 3 * rest))
            self._board.beat = cmd_vel(ahead * share, turn * share) + HEARTBEAT
            rest = left(self.look())
        self._board.beat = cmd_vel(0.0) + HEARTBEAT
        self._board.run(1.0)
        return self.look()

    def look(self):
        """Return the next odometry."""
        self.told.append(Pose(*struct.unpack('<5f', self._board.next(ODOM)[0])[:3]))
        self.true.append(Pose(self._board.get('x'), self._board.get('y'),
                              math.radians(self._board.get('yaw'))))
        return self.told[-1]


def measure():
    """The poses of the base and of its odometry."""
    booted = Booted(build_firmware(), 'diff')
    drive = Drive(booted.copy())
    begin = drive.look()
    for number in range(1, 5):
        begin = drive.until(lambda at, begin=begin: SIDE - math.hypot(
            at.x - begin.x, at.y - begin.y), 0.3, 0.0)
        begin = drive.until(lambda at, number=number: math.remainder(
            number * math.pi / 2 - at.yaw, 2 * math.pi), 0.0, 1.2)
    booted.close()
    return drive.true, drive.told


def with_track(poses, factor):
    """What the odometry would be if the track in the sketch were larger by a factor."""
    places, x, y, turned = [(0.0, 0.0)], 0.0, 0.0, 0.0
    for first, second in zip(poses, poses[1:]):
        turn = math.remainder(second.yaw - first.yaw, 2 * math.pi)
        middle = first.yaw + turn / 2
        ahead = (second.x - first.x) * math.cos(middle) + (second.y - first.y) * math.sin(middle)
        x += ahead * math.cos(turned + turn / factor / 2)
        y += ahead * math.sin(turned + turn / factor / 2)
        turned += turn / factor
        places.append((x, y))
    return places


def line(places, kind):
    points = (f'{_LEFT + _SCALE * x:.1f},{_TOP - _SCALE * y:.1f}' for x, y, *_ in places)
    different = ' '.join(point for point, _ in itertools.groupby(points))
    return f'<path class="{kind}" d="M {different}"/>'


def picture(true, told):
    """All of them as the text of an SVG."""
    base, believed = true[-1], told[-1]
    wrong = with_track(told, WRONG)
    off = math.hypot(base.x - believed.x, base.y - believed.y) * 1000
    turned = abs(math.degrees(math.remainder(base.yaw - believed.yaw, 2 * math.pi)))
    astray = math.hypot(base.x - wrong[-1][0], base.y - wrong[-1][1]) * 1000
    grid = ''.join(
        f'<line x1="{_LEFT + _SCALE * at}" x2="{_LEFT + _SCALE * at}" y1="{_TOP - _SCALE * 1.1}" '
        f'y2="{_TOP + 20}"/><text x="{_LEFT + _SCALE * at}" y="{_TOP + 40}" text-anchor="middle">'
        f'{at:g} m</text><line x1="{_LEFT - 20}" x2="{_LEFT + _SCALE * 1.1}" '
        f'y1="{_TOP - _SCALE * at}" y2="{_TOP - _SCALE * at}"/>'
        f'<text x="{_LEFT - 30}" y="{_TOP - _SCALE * at + 5}" text-anchor="end">{at:g} m</text>'
        for at in (0, 0.5, 1))
    words = ''.join(
        f'<path class="{kind}" d="M 570,{y - 5} 610,{y - 5}"/>' * bool(kind)
        + f'<text x="{620 if kind else 570}" y="{y}">{text}</text>'
        for kind, y, text in (
            ('true', 130, 'where the base was'), ('told', 160, 'where its odometry had it'),
            ('', 184, f'in the end {off:.1f} mm and {turned:.2f}° off'),
            ('wrong', 230, f'with a track {(WRONG - 1) * 100:.0f} % too large'),
            ('', 254, f'in the end {astray:.0f} mm off')))
    return (f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{_HEIGHT}">'
            f'<style>{_STYLE}</style><rect width="{_WIDTH}" height="{_HEIGHT}" fill="#fff"/>'
            '<text class="title" x="20" y="32">A square of 1 m, driven to the left by the emulated '
            'base, and its odometry</text>'
            f'{grid}{line(true, "true")}{line(told, "told")}{line(wrong, "wrong")}{words}</svg>\n')
