"""The picture of a wheel's step response before and after its gains were tuned; an SVG.

It is measured with the example Tuning on an emulated board: tuning_picture.py FOLDER.
"""
import itertools
import struct
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / part) for part in ('firmware', 'helpers')]

from by_definition import SETTING, arduino_packet  # noqa: E402
from emulated_board import Booted, build_firmware  # noqa: E402
from packets import HEARTBEAT, WHEEL_SPEED, target  # noqa: E402

GAINS = 'kp', 'ki', 'kd'            # settings 1 to 3
STEP = 8                            # turns/s
SECONDS = 3
# Gains, color, and what to say of them. The first are those of the sketch.
CURVES = (((4, 20, 0), '#d1495b', 'before'), ((40, 200, 0), '#00798c', 'after'),
          ((20, 1000, 0), '#b08900', 'too much ki'))
_LEFT, _TOP, _WIDTH, _HEIGHT = 60, 75, 800, 340     # of the plot, in pixels
_MOST = 10                # turns/s, at the top


def response(board, gains):
    """Turns/s of the wheel every 10 ms, from its first motion after a step from 0 to `STEP`."""
    for number, gain in enumerate(gains, 1):
        board.send(arduino_packet(SETTING, struct.pack('<Bf', number, gain)))
    board.run(0.1)
    board.forget()
    board.beat = target(STEP) + HEARTBEAT
    board.run(SECONDS + 0.5)
    speeds = (struct.unpack('<f', data)[0] for data in board.seen(WHEEL_SPEED))
    return list(itertools.dropwhile(lambda speed: speed == 0, speeds))[:100 * SECONDS]


def measure(build):
    """The response to a step with each of the gains."""
    booted = Booted(build, 'car', 'Tuning.elf')
    found = [response(booted.copy(), gains) for gains, _, _ in CURVES]
    booted.close()
    return found


def picture(responses):
    """The responses as an SVG."""
    def y(speed):
        return _TOP + _HEIGHT * (1 - speed / _MOST)

    def x(seconds):
        return _LEFT + _WIDTH * seconds / SECONDS
    parts = [f'<line x1="{_LEFT}" x2="{x(SECONDS)}" y1="{y(speed)}" y2="{y(speed)}"/>'
             f'<text x="{_LEFT - 10}" y="{y(speed) + 5}" text-anchor="end">{speed}</text>'
             for speed in range(0, _MOST + 1, 2)]
    parts += [f'<text x="{x(half / 2)}" y="{_TOP + _HEIGHT + 25}" text-anchor="middle">'
              f'{half / 2:g} s</text>' for half in range(2 * SECONDS + 1)]
    parts.append(f'<path d="M{_LEFT} {y(STEP)}H{x(SECONDS)}" stroke="#333" '
                 'stroke-dasharray="6 4"/>')
    for index, (found, (gains, color, words)) in enumerate(zip(responses, CURVES)):
        points = ' '.join(f'{x(0.01 * at):.1f},{y(speed):.1f}' for at, speed in enumerate(found))
        values = ', '.join(f'{name} {gain}' for name, gain in zip(GAINS, gains))
        parts.append(f'<polyline points="{points}" stroke="{color}" stroke-width="2.5"/>'
                     f'<text x="{_LEFT + 270 * index}" y="56" style="fill: {color}">'
                     f'{words}: {values}</text>')
    return (f'<svg xmlns="http://www.w3.org/2000/svg" width="{_LEFT + _WIDTH + 30}" '
            f'height="{_TOP + _HEIGHT + 45}">\n<style>text {{ font: 15px sans-serif; fill: #333 }} '
            'line { stroke: #ddd } path, polyline { fill: none }</style>\n'
            '<rect width="100%" height="100%" fill="#fff"/>\n'
            f'<text x="20" y="28" style="font-weight: bold">Speed of the wheel after a step of the '
            f'target from 0 to {STEP} turns/s (dashed)</text>\n' + '\n'.join(parts) + '\n</svg>\n')


def make(folder):
    """Write tuning.svg into this folder."""
    path = Path(folder) / 'tuning.svg'
    path.write_text(picture(measure(build_firmware())))
    print(f'{path}: {path.stat().st_size / 1024:.0f} KiB', flush=True)


if __name__ == '__main__':
    make(sys.argv[1])
