"""The picture of stamps with and without the board's time: errors behind an adapter of 16 ms."""
import threading
import time

from boards import until
from links import ArduinoLink
from serial_communication.boards.arduino import wire
from serial_communication.boards.arduino.simulator import ModelCar
from serial_communication.simulation.board import Runner
from serial_communication.simulation.faults import Faults, parse
from serial_communication.transport.port import Port

SECONDS, DRIFT, BATCH = 5.0, 300, 16     # DRIFT in ppm, BATCH in ms
_LEFT, _TOP, _WIDTH, _HEIGHT = 70, 70, 880, 400     # of the plot, in pixels
_MOST = 24                # ms, at the top
_STYLE = '''body { margin: 0 } svg { display: block; background: #fff;
font: 15px "DejaVu Sans", sans-serif; fill: #333 } .title { font-size: 17px; font-weight: bold }
.read { fill: #d1495b } .board { fill: #00798c } line { stroke: #ddd }'''


class Car(ModelCar):
    """Knows when it was switched on."""

    booted = 0.0

    def power_on(self, now):
        self.booted = now
        super().power_on(now)


def measure(line):
    """The points (s, error of the read's stamp in ms, error of the board's) of each turn, on a pair
    of ports."""
    points, car = [], Car()
    latest = {}      # the latest TIME: its value, and the stamp of its read
    link = ArduinoLink(Port(line.near), clock=time.monotonic, on_message=lambda message, stamp:
                       isinstance(message, wire.Ticks) and points.append((*latest.values(), stamp)))

    def shown(_link, _direction, frame):
        if frame.type == wire.Time.TYPE:
            latest.update(ticks=frame.ticks, read=frame.stamp)
    link.session.tap = shown
    link.start()
    runner = Runner(car, Port(line.far),
                    faults=Faults(parse(f'drift={DRIFT} batch={BATCH}', car)))
    threading.Thread(target=runner.run, daemon=True).start()
    until(lambda: len(points) >= 100 * SECONDS, 'the car has sent', 60)
    for each in runner, link:
        each.stop()
    link.join()
    found = []
    for ticks, read, stamp in points:
        at = ticks / (1e6 + DRIFT)
        found.append((at, (read - car.booted - at) * 1e3, (stamp - car.booted - at) * 1e3))
    return found


def page(points):
    """The points as a page with a picture of them."""
    begin, end = points[0][0], points[-1][0]

    def y(error):
        return _TOP + _HEIGHT * (1 - error / _MOST)

    def dots(index, kind):
        return ''.join(
            f'<circle class="{kind}" r="2.2" cy="{y(min(point[index], _MOST)):.1f}" '
            f'cx="{_LEFT + _WIDTH * (point[0] - begin) / (end - begin):.1f}"/>' for point in points)
    grid = ''.join(
        f'<line x1="{_LEFT}" x2="{_LEFT + _WIDTH}" y1="{y(error)}" y2="{y(error)}"/>'
        f'<text x="{_LEFT - 10}" y="{y(error) + 5}" text-anchor="end">{error}</text>'
        for error in range(0, _MOST + 1, 4))
    seconds = ''.join(
        f'<text x="{_LEFT + _WIDTH * second / (end - begin)}" y="{_TOP + _HEIGHT + 25}" '
        f'text-anchor="middle">{second} s</text>' for second in range(int(end - begin) + 1))
    return (f'<!DOCTYPE html><meta charset="utf-8"><style>{_STYLE}</style>'
            f'<svg width="{_LEFT + _WIDTH + 30}" height="{_TOP + _HEIGHT + 45}">'
            '<text class="title" x="20" y="28">ms from the measurement to the stamp, 100 Hz behind '
            f'a USB adapter that delivers every {BATCH} ms</text>'
            f'<text class="read" x="{_LEFT}" y="54">● stamp of the read</text>'
            f'<text class="board" x="{_LEFT + 200}" y="54">● stamp by the board\'s time, '
            'known after one second</text>'
            f'{grid}{seconds}{dots(1, "read")}{dots(2, "board")}</svg>')
