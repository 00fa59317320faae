"""The picture of a square that the emulated base drove, and of its odometry."""
import itertools
import math
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / 'firmware'))

from driven_base import base_end  # noqa: E402
from emulated_board import build_firmware  # noqa: E402

SIDE = 1.0          # m
WRONG = 1.03        # factor of a track that was measured badly
_SCALE = 340        # pixels per m
_LEFT, _TOP, _WIDTH, _HEIGHT = 150, 470, 860, 530
_STYLE = '''text { font: 15px "DejaVu Sans", sans-serif; fill: #333 }
.title { font-size: 17px; font-weight: bold } path { fill: none }
.true { stroke: #9fc5d8; stroke-width: 9 } .told { stroke: #00506b; stroke-width: 2 }
.wrong { stroke: #d1495b; stroke-width: 2; stroke-dasharray: 7 5 } line { stroke: #ddd }'''


def measure():
    """The places (x, y) of the base and of its odometry; and both in the end, as a Pose."""
    true, told = [], []
    with base_end(build_firmware()) as base:
        def seen():
            true.append(base.truth()[:2])
            told.append(base.believed())
        base.drive_square(SIDE, seen)
        return true, told, base.truth(), base.believed()


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


def picture(true, told, base, believed):
    """All of them as the text of an SVG."""
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
