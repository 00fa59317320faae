#!/usr/bin/env python3
"""Makes the recordings of doc/wire.md: python3 test/tools/wire_recordings.py [FOLDER].

Each records a simulated board with faults over real ttys: with `wire listen`, or with `wire tap`
between it and a link of the bridge. It takes ten seconds. The page describes those in doc/wire.
"""
import bisect
import itertools
import os
import pty
import subprocess
import sys
import tempfile
import threading
import time
import tty
from contextlib import contextmanager

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, ROOT)

from serial_communication.boards.arduino.link import ArduinoLink  # noqa: E402
from serial_communication.boards.bus.link import BusLink, BusSettings  # noqa: E402
from serial_communication.transport.port import Port  # noqa: E402
from serial_communication.boards.arduino.simulator import ModelCar  # noqa: E402
from serial_communication.simulation.board import Runner  # noqa: E402
from serial_communication.boards.bus.simulator import ControlBoard  # noqa: E402
from serial_communication.simulation.faults import Faults  # noqa: E402
from serial_communication.boards.mcu.simulator import SensorBoard  # noqa: E402

WIRE = [sys.executable, os.path.join(ROOT, 'scripts', 'wire')]
SOCAT_PAIR = os.path.join(ROOT, 'scripts', 'socat_pair')
PATIENCE = 15.0


def wait_for(condition, what):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f'not within {PATIENCE:g} s: {what}'
        time.sleep(0.01)


# -- the stage ------------------------------------------------------------------------------------

class Stage:
    """Ports for a board, a tap and a computer on one line."""

    def __init__(self, folder):
        self.ports = {name: os.path.join(folder, name) for name in (
            'computer', 'tap_computer', 'tap_board', 'board')}
        self._programs = [subprocess.Popen([SOCAT_PAIR, self.ports[a], self.ports[b]])
                          for a, b in (('computer', 'tap_computer'), ('tap_board', 'board'))]
        wait_for(lambda: all(map(os.path.exists, self.ports.values())), 'the ports')

    @contextmanager
    def tapped(self, link, path):
        """Run `wire tap --raw` until the block ends."""
        with tempfile.TemporaryFile() as output:
            program = subprocess.Popen(
                WIRE + ['tap', link, self.ports['tap_board'], self.ports['tap_computer'], '--raw',
                        path], stdout=subprocess.DEVNULL, stderr=output)
            wait_for(lambda: output.seek(0) == 0 and output.read().count(b'open') == 2, 'the tap')
            try:
                yield
            finally:
                program.terminate()
                program.wait()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for program in self._programs:
            program.kill()
            program.wait()


@contextmanager
def running(board, port, faults=None):
    """Run a simulated board in a thread until the block ends."""
    runner = Runner(board, Port(port), faults=faults)
    thread = threading.Thread(target=runner.run, name='board', daemon=True)
    thread.start()
    try:
        yield
    finally:
        runner.stop()
        thread.join()


@contextmanager
def computer(link):
    """Run one of the bridge's links until the block ends."""
    link.start()
    try:
        wait_for(lambda: link.port.is_open, 'the port')
        yield link
    finally:
        link.stop()
        link.join()


# -- a wrong baud rate ----------------------------------------------------------------------------

def received_at(data, sent_baud, received_baud):
    """What a UART at another baud rate receives of bytes sent back to back."""
    levels = []                             # of the line, one for each bit
    for byte in data:
        levels += [0] + [byte >> bit & 1 for bit in range(8)] + [1]
    levels += [1] * 20
    step = sent_baud / received_baud        # sent bits in a received one
    received, at = bytearray(), 0.0
    while True:
        while int(at) < len(levels) and levels[int(at)]:
            at = int(at) + 1                # the line is idle until a start bit
        if at + 9.5 * step >= len(levels):
            return bytes(received)
        received.append(sum(levels[int(at + (bit + 1.5) * step)] << bit for bit in range(8)))
        at += 9.5 * step                    # the middle of the stop bit: ready for the next


def baud(folder, path):
    """One second of a sensor board at 115200 baud, received at 57600."""
    (board, board_device), (receiver, receiver_device) = pty.openpty(), pty.openpty()
    for device in board_device, receiver_device:
        tty.setraw(device)

    def garble():
        while True:
            data = os.read(board, 4096)
            if not data:
                return
            os.write(receiver, received_at(data, 115200, 57600))

    threading.Thread(target=garble, name='line', daemon=True).start()
    with running(SensorBoard(seed=1), os.ttyname(board_device)):
        subprocess.run(WIRE + ['listen', 'mcu', os.ttyname(receiver_device), '--baud', '57600',
                               '--raw', path, '--duration', '1'], stdout=subprocess.DEVNULL,
                       stderr=subprocess.DEVNULL, check=True)


# -- a board that resets under load ---------------------------------------------------------------

class WeakSupply(Faults):
    """The supply fails when the motor runs fast: the board resets, once."""

    def __init__(self):
        super().__init__()
        self.board = ModelCar(seed=2)
        self._full_since = None
        self.has_failed = False

    def events(self, now):
        if self.has_failed or not self.board.motor_on or self.board.command < 800:
            return []
        self._full_since = self._full_since or now
        if now < self._full_since + 0.1:
            return []
        self.has_failed = True
        return [('reset', 0.4)]


def reset(folder, path):
    """0.9 s around the reset of a car that is sent a high speed."""
    whole = os.path.join(folder, 'whole.txt')
    supply = WeakSupply()
    with Stage(folder) as stage, stage.tapped('arduino', whole):
        with running(supply.board, stage.ports['board'], supply), \
                computer(ArduinoLink(Port(stage.ports['computer']))) as car:
            drive(car, 300, 0.4, lambda: True)
            drive(car, 900, 0.0, lambda: supply.has_failed)
            drive(car, 900, 0.9, lambda: place_of(whole, b'avrboot'))
    cut(whole, path, b'avrboot', 0.3, 0.6)


def drive(car, speed, seconds, condition):
    """Send a speed for that long at least, until the condition holds."""
    began = time.monotonic()
    while not condition() or time.monotonic() < began + seconds:
        assert time.monotonic() < began + PATIENCE, f'not within {PATIENCE:g} s: speed {speed}'
        car.set_speed(speed)
        time.sleep(0.1)


def lines_of(whole):
    """Return the lines of a recording, as lists of words; the last one may not be complete."""
    with open(whole, encoding='utf-8') as file:
        return [line.split() for line in file if line.endswith('\n')]


def place_of(whole, data):
    """Return when the board's bytes `data` were recorded, in s; None if they were not.

    They may be in several lines: a program that gets little processor time reads parts.
    """
    received = [line for line in lines_of(whole) if line[1] == 'rx']
    ends = list(itertools.accumulate(len(line[2]) for line in received))
    place = ''.join(line[2] for line in received).find(data.hex())
    return float(received[bisect.bisect(ends, place)][0]) if place >= 0 else None


def cut(whole, path, data, before, after):
    """Copy the part of a recording around the first of the board's bytes `data`."""
    middle = place_of(whole, data)
    with open(path, 'w', encoding='utf-8') as file:
        for line in lines_of(whole):
            if line[0] == '#':
                if 'open' not in line:
                    file.write(' '.join(line) + '\n')
            elif middle - before <= float(line[0]) <= middle + after:
                file.write(' '.join(line) + '\n')


# -- a late reply ---------------------------------------------------------------------------------

class SlowOnce(Faults):
    """Delays the reply to the lift, once, for longer than the Master waits."""

    def sent(self, frame, now):
        fate = super().sent(frame, now)
        if frame == bytes.fromhex('a50002a7') and not self.counts:
            self.counts['late'] = 1
            return fate._replace(delay=0.8)
        return fate


def late(folder, path):
    """A lift that answers 0.8 s late, where the Master waits for 0.5 s."""
    settings = BusSettings(motion_timeout=0.5, environment_period=1.0)
    with Stage(folder) as stage, stage.tapped('bus', path):
        with running(ControlBoard(lift_speed=1000.0, seed=3), stage.ports['board'], SlowOnce()), \
                computer(BusLink(Port(stage.ports['computer']), settings)) as bus:
            bus.echo()
            bus.lift(0, 40)
            time.sleep(1.0)
            bus.lift(0, 40)


RECORDINGS = {'baud': baud, 'reset': reset, 'late': late}


def main():
    target = sys.argv[1] if len(sys.argv) > 1 else os.path.join(ROOT, 'doc', 'wire')
    for name, record in RECORDINGS.items():
        with tempfile.TemporaryDirectory(prefix='wire') as folder:
            record(folder, os.path.join(target, name + '.txt'))
        print(os.path.join(target, name + '.txt'))


if __name__ == '__main__':
    main()
