"""The computer's end of the example Tuning: its settings, and the response of its wheel to a step.

The picture of the tutorial is made with it, too.
"""
import itertools
import struct

from board_ends import HEARTBEAT, SETTING, packet

TARGET, WHEEL_SPEED = 32, 33         # its messages
GAINS = 'kp', 'ki', 'kd'             # settings 1 to 3
STEP = 8                             # turns/s


def set_to(car, layout, number, value, used=None):
    """Set one, as the bridge does; wait until the board reports that it uses it, or `used`."""
    car.forget()
    car.send(SETTING, struct.pack('<B' + layout, number, value))
    report = struct.pack('<B' + layout, number, value if used is None else used)
    car.board.wait_until(lambda: report in car.read(SETTING), 2)


def hold(car, command, seconds):
    """Send a command and a heartbeat every 10 ms of the wire, in time however busy this machine is.

    Empty packets fill the gaps: the emulated line takes one byte after the other at its speed.
    """
    packets = command + packet(HEARTBEAT)
    beat = bytes(115 - len(packets)) + packets
    end = car.board.get('rx_bytes') + 1150 * round(10 * seconds)
    for _ in range(round(10 * seconds)):
        car.port.write(10 * beat)
        car.read()
    car.board.wait_until(lambda: car.read() or car.board.get('rx_bytes') >= end, seconds + 1)


def target(turns):
    return packet(TARGET, struct.pack('<f', turns))


def speeds(car):
    return [struct.unpack('<f', data)[0] for data in car.read(WHEEL_SPEED)]


def response(car, seconds):
    """Turns/s of the wheel every 10 ms, from its first motion after a step from 0 to `STEP`."""
    hold(car, target(0), 2)
    car.forget()
    hold(car, target(STEP), seconds)
    return list(itertools.dropwhile(lambda speed: speed == 0, speeds(car)))
