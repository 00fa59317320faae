"""Pictures of what is measured with emulated and simulated boards, as texts of SVGs."""
import itertools
import math
import struct
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / part) for part in ('firmware', 'helpers')]

from by_definition import SETTING, arduino_packet  # noqa: E402
from emulated_board import Booted, build_firmware  # noqa: E402
from links import ArduinoLink  # noqa: E402
from packets import HEARTBEAT, ODOM, WHEEL_SPEED, cmd_vel, target  # noqa: E402
from simulation_bench import Bench  # noqa: E402

from serial_communication.boards.arduino import wire  # noqa: E402
from serial_communication.boards.arduino.simulator import ModelCar  # noqa: E402
from serial_communication.simulation.faults import Faults, parse  # noqa: E402
from serial_communication.transport.port import Port  # noqa: E402

# Colors and widths of curves.
RED, BLUE, BROWN = ('#d1495b', 2.5), ('#00798c', 2.5), ('#b08900', 2.5)
WIDE, DOTS_RED, DOTS_BLUE = ('#9fc5d8', 9), ('#d1495b', 4.5), ('#00798c', 4.5)
_LEFT, _TOP = 80, 180     # of a plot, in pixels
_STYLE = '''text { font: 15px "DejaVu Sans", sans-serif; fill: #333 } line { stroke: #ddd }
path { fill: none; stroke-linecap: round }'''


def plot(title, size, x_axis, y_axis, curves):
    """Return a plot.

    Args:
        size: its width and height in pixels.
        x_axis, y_axis: the numbers at an axis, and their unit.
        curves: points (x, y), color and width, label; of dots where the label begins with one.
    """
    (x_ticks, x_unit), (y_ticks, y_unit) = x_axis, y_axis

    def x(value):
        return _LEFT + size[0] * (value - x_ticks[0]) / (x_ticks[-1] - x_ticks[0])

    def y(value):
        return _TOP + size[1] * (y_ticks[-1] - value) / (y_ticks[-1] - y_ticks[0])
    bottom, right = y(y_ticks[0]), x(x_ticks[-1])
    parts = [f'<text x="20" y="28" style="font-weight: bold">{title}</text>']
    for tick in x_ticks:
        parts.append(f'<line x1="{x(tick)}" x2="{x(tick)}" y1="{_TOP}" y2="{bottom}"/>'
                     f'<text x="{x(tick)}" y="{bottom + 25}" text-anchor="middle">'
                     f'{tick:g} {x_unit}</text>')
    for tick in y_ticks:
        parts.append(f'<line x1="{_LEFT}" x2="{right}" y1="{y(tick)}" y2="{y(tick)}"/>'
                     f'<text x="{_LEFT - 10}" y="{y(tick) + 5}" text-anchor="end">'
                     f'{tick:g} {y_unit}</text>')
    for number, (points, (color, width), label) in enumerate(curves):
        places = (f'{x(at):.1f},{y(value):.1f}' for at, value in points)
        line = ('h0M' if label.startswith('●') else 'L').join(
            place for place, _ in itertools.groupby(places))
        parts.append(f'<path d="M{line}h0" stroke="{color}" stroke-width="{width}"/>'
                     f'<text x="{_LEFT}" y="{60 + 24 * number}" style="fill: {color}">'
                     f'{label}</text>')
    return (f'<svg xmlns="http://www.w3.org/2000/svg" width="{right + 40}" '
            f'height="{bottom + 45}">\n<style>{_STYLE}</style>\n'
            '<rect width="100%" height="100%" fill="#fff"/>\n' + '\n'.join(parts) + '\n</svg>\n')


# -- a square that the emulated base drives by its odometry ---------------------------------------

SIDE = 1.0          # m
WRONG = 1.03        # factor of a track that was measured badly


class Drive:
    """The emulated base, driven by its odometry as a program on the computer would."""

    def __init__(self, board):
        self._board = board
        self.true, self.told = [], []      # poses (m, m, rad) of the base and of its odometry

    def until(self, left, ahead, turn):
        """Drive until `left(pose)` is 0, slower and slower at the end; and stop."""
        rest = 1.0
        while rest > 0:
            share = min(1.0, max(0.1, 3 * rest))
            self._board.beat = cmd_vel(ahead * share, turn * share) + HEARTBEAT
            rest = left(*self.look())
        self._board.beat = cmd_vel(0.0) + HEARTBEAT
        self._board.run(1.0)
        return self.look()

    def look(self):
        """Return the next odometry."""
        self.told.append(struct.unpack('<5f', self._board.next(ODOM)[0])[:3])
        self.true.append((self._board.get('x'), self._board.get('y')))
        return self.told[-1]


def with_track(poses, factor):
    """Where the odometry would be if the track in the sketch were larger by a factor."""
    places, x, y, turned = [(0.0, 0.0)], 0.0, 0.0, 0.0
    for (old_x, old_y, old_yaw), (new_x, new_y, new_yaw) in zip(poses, poses[1:]):
        turn = math.remainder(new_yaw - old_yaw, 2 * math.pi)
        middle = old_yaw + turn / 2
        ahead = (new_x - old_x) * math.cos(middle) + (new_y - old_y) * math.sin(middle)
        x += ahead * math.cos(turned + turn / factor / 2)
        y += ahead * math.sin(turned + turn / factor / 2)
        turned += turn / factor
        places.append((x, y))
    return places


def square():
    """The picture of the square."""
    booted = Booted(build_firmware(), 'diff')
    drive = Drive(booted.copy())
    begin = drive.look()
    for number in range(1, 5):
        begin = drive.until(lambda x, y, _yaw, begin=begin: SIDE - math.hypot(
            x - begin[0], y - begin[1]), 0.3, 0.0)
        begin = drive.until(lambda _x, _y, yaw, number=number: math.remainder(
            number * math.pi / 2 - yaw, 2 * math.pi), 0.0, 1.2)
    booted.close()
    curves = [(drive.true, WIDE, 'where the base was')]
    for places, color, label in (
            ([pose[:2] for pose in drive.told], BLUE, 'where its odometry had it'),
            (with_track(drive.told, WRONG), RED, f'with a track {WRONG - 1:.0%} too large')):
        off = math.dist(places[-1], drive.true[-1]) * 1000
        curves.append((places, color, f'{label}: in the end {off:.1f} mm off'))
    return plot('A square of 1 m, driven to the left by the emulated base, and its odometry',
                (620, 500), ([-0.25, 0, 0.5, 1], 'm'), ([0, 0.5, 1], 'm'), curves)


# -- stamps with and without the board's time, behind an adapter ----------------------------------

SECONDS, DRIFT, BATCH = 5.0, 300, 16     # DRIFT in ppm, BATCH in ms


def stamps():
    """The picture of the stamps: an adapter that holds bytes, in simulated time."""
    car, read, board = ModelCar(), [], []
    ticks = []      # the latest TIME

    def shown(_link, _direction, frame):
        if frame.type == wire.Time.TYPE:
            ticks[:] = [frame.ticks]

    def received(message, stamp):
        if isinstance(message, wire.Ticks):
            at = ticks[0] / (1e6 + DRIFT)       # s since the start of the board, `began`
            read.append((at, (now - began - at) * 1e3))
            board.append((at, (stamp - began - at) * 1e3))
    link = ArduinoLink(Port('/dev/none'), on_message=received)
    link.session.tap = shown
    bench = Bench(car, None, faults=Faults(parse(f'drift={DRIFT} batch={BATCH}', car)))
    began = bench.now
    bench.run(SECONDS)
    for now, data in bench.wire:
        link.receiver.take(data, now, now)
    return plot(f'From the measurement to the stamp, 100 Hz behind a USB adapter that delivers '
                f'every {BATCH} ms (simulated)', (880, 400), (range(6), 's'),
                (range(0, 17, 4), 'ms'),
                [(read, DOTS_RED, '● stamp of the read'),
                 (board, DOTS_BLUE, "● stamp by the board's time, known after one second")])


# -- a wheel's step response before and after its gains are tuned ---------------------------------

STEP, LASTS = 8, 3                  # turns/s, s
# Gains kp, ki and kd, color, and what to say of them. The first are those of the sketch.
GAINS = (((4, 20, 0), RED, 'before'), ((40, 200, 0), BLUE, 'after'),
         ((20, 1000, 0), BROWN, 'too much ki'))


def response(board, gains):
    """(s, turns/s) of the wheel every 10 ms, from its first motion after the step."""
    for number, gain in enumerate(gains, 1):
        board.send(arduino_packet(SETTING, struct.pack('<Bf', number, gain)))
    board.run(0.1)
    board.forget()
    board.beat = target(STEP) + HEARTBEAT
    board.run(LASTS + 0.5)
    speeds = (struct.unpack('<f', data)[0] for data in board.seen(WHEEL_SPEED))
    moving = itertools.dropwhile(lambda speed: speed == 0, speeds)
    return [(at / 100, speed) for at, speed in zip(range(100 * LASTS), moving)]


def tuning():
    """The picture of the step responses."""
    booted = Booted(build_firmware(), 'car', 'Tuning.elf')
    curves = [(response(booted.copy(), gains), color, '{}: kp {}, ki {}, kd {}'.format(
        words, *gains)) for gains, color, words in GAINS]
    booted.close()
    return plot(f'Speed of the wheel in turns/s after a step of the target from 0 to {STEP}',
                (800, 340), (range(LASTS + 1), 's'), (range(0, 11, 2), ''), curves)
