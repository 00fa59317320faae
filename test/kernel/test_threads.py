"""Links with their threads on real ttys: races of threads, other programs, and the end.

What follows from rules is in test/sim and test/unit, where the time is that of the test.
"""
import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import termios
import threading
import time

import pytest
import serial.serialposix
from waiting import Waiter, until

from serial_communication.boards.arduino import wire as arduino
from links import ArduinoLink, McuLink
from serial_communication.boards.arduino.session import CarOptions
from serial_communication.boards.mcu import wire as mcu
from serial_communication.link.session import ERROR, Refused
from serial_communication.transport import open_port
from serial_communication.transport.port import Port

STOP = arduino.encode(arduino.SpeedCommand(0))
STATUS = mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)
_BORROWER = '''
import sys, time, serial
port = serial.Serial(sys.argv[1], 9600, xonxoff=True)
print('open', flush=True)
exec(sys.argv[2])
'''


def packets(data):
    """The packets in what the board received, without heartbeats."""
    return [part + b'\0' for part in data.split(b'\0') if part not in (b'', b'\x02\x0b')]


@pytest.fixture
def car(line, running):
    link = running(ArduinoLink(Port(line.path), CarOptions(speed_timeout=0.0)))
    until(lambda: link.session.heartbeats.sent)
    return link


@pytest.fixture
def sensors(line, running):
    link = running(McuLink(Port(line.path)))
    until(lambda: link.port.is_open)
    return link


# -- races ----------------------------------------------------------------------------------------

@contextlib.contextmanager
def drivers(car):
    """Context in which several threads command speeds at full rate."""
    ending = threading.Event()

    def command():
        while not ending.is_set():
            try:
                car.set_speed(700)
            except Refused:
                time.sleep(0.001)

    waiters = [Waiter(command) for _ in range(3)]
    try:
        yield
    finally:
        ending.set()
        for waiter in waiters:
            waiter.join()


def test_speed_0_is_first_although_threads_command_while_the_port_is_opened(line, car):
    with drivers(car):
        for _ in range(20):
            line.unplug()
            until(lambda: not car.port.is_open)
            line.plug()
            received = bytearray()
            until(lambda: len(packets(received)) > 1,
                  doing=lambda: received.extend(line.read(0.01)), every=0.0)
            assert packets(received)[0] == STOP


def test_no_speed_follows_a_stop_that_is_called_while_threads_write(line, car):
    speed = arduino.encode(arduino.SpeedCommand(700))
    with drivers(car):
        for _ in range(20):
            received = bytearray()
            until(lambda: speed in received, doing=lambda: received.extend(line.read(0.01)))
            car.session.is_stopped = True
            assert car.stop_motion() == ''
            beats = car.session.heartbeats.sent
            until(lambda: car.session.heartbeats.sent > beats + 10,
                  doing=lambda: received.extend(line.read(0.0)))
            assert speed not in received[received.rindex(STOP):]
            assert STOP in received[received.rindex(speed):]
            car.session.is_stopped = False


def test_no_command_of_any_thread_follows_the_last_speed_0_before_a_loan(line, car):
    received = []
    ending = threading.Event()
    reader = Waiter(lambda: [received.append(line.read(0.02)) for _ in iter(ending.is_set, True)])
    try:
        with drivers(car):
            for _ in range(5):
                until(lambda: car.lending.lend('avrdude', 5.0))
                until(car.lending.closed.is_set)
                seen = len(received)    # a read that has begun since then finds nothing
                until(lambda: len(received) > seen + 1 and not received[-1])
                assert b''.join(received).endswith(STOP) and not car.port.is_open
                car.lending.lend('avrdude', 0)
                until(lambda: car.port.is_open)
    finally:
        ending.set()
        reader.join()


# -- other programs -------------------------------------------------------------------------------

@pytest.fixture
def borrow(line):
    """A function that opens the tty in another program, which then runs some Python."""
    begun = []

    def start(then='time.sleep(600)'):
        begun.append(subprocess.Popen([sys.executable, '-c', _BORROWER, line.path, then],
                                      stdout=subprocess.PIPE))
        assert begun[-1].stdout.readline() == b'open\n', 'it is locked'
        return begun[-1]

    yield start
    for process in begun:
        process.kill()
        process.wait()
        process.stdout.close()


def lend(link, seconds):
    link.lending.lend('avrdude', seconds)
    until(link.lending.closed.is_set)


def test_a_lent_port_is_free_and_after_the_loan_waits_for_who_still_has_it_open(sensors, borrow):
    """Whoever renewed the loan was killed, and its upload goes on; it does not lock the port."""
    lend(sensors, 5.0)
    upload = borrow()
    sensors.lending.lend('avrdude', 0.1)
    until(lambda: 'still has it open' in sensors.reopening.trouble)
    assert sensors.report(0.0)[:2] == (
        ERROR, 'closed: it was lent to avrdude, and another program still has it open')
    os.kill(upload.pid, signal.SIGKILL)
    until(lambda: sensors.port.is_open)


def test_what_the_borrower_did_to_the_tty_is_put_right(line, sensors, borrow):
    lend(sensors, 10.0)
    borrow('import termios, os; os.system("stty sane ixon 9600 < " + sys.argv[1]); '
           'termios.tcflow(port.fileno(), termios.TCOOFF)').wait()
    assert b'9600' in subprocess.check_output(['stty', '-F', line.path])
    sensors.lending.lend('avrdude', 0)
    until(lambda: sensors.port.is_open and sensors.reopening.count == 2)
    every = bytes(range(256))
    sensors.port.write(every)
    assert line.read_all() == every
    until(lambda: sensors.session.frames_received or line.write(STATUS))


@pytest.mark.parametrize('by, expected', [
    ('dtr', [('dtr', False), ('dtr', True)]),
    ('rts', [('dtr', False), ('rts', True), ('rts', False)])])
def test_a_reset_is_a_pulse_of_100_ms(port, line, monkeypatch, by, expected):
    changes, ioctl = [], fcntl.ioctl
    bits = {termios.TIOCMBIS: True, termios.TIOCMBIC: False}
    names = {termios.TIOCM_DTR: 'dtr', termios.TIOCM_RTS: 'rts'}

    def fake(fd, request, argument=0, *more):
        if request not in bits:
            return ioctl(fd, request, argument, *more)
        name = names[int.from_bytes(argument, sys.byteorder)]
        changes.append((name, bits[request], time.monotonic()))
        return argument

    monkeypatch.setattr(serial.serialposix.fcntl, 'ioctl', fake)
    monkeypatch.setattr(open_port, '_PTY', ())
    port.pulse(by)
    assert [each[:2] for each in changes] == expected
    assert changes[-1][2] - changes[-2][2] >= 0.1


# -- the end --------------------------------------------------------------------------------------


def test_the_last_packet_of_a_bridge_that_ends_is_speed_0(line, car):
    with drivers(car):
        received = bytearray()
        until(lambda: len(received) > 200, doing=lambda: received.extend(line.read(0.01)))
        car.stop()
    car.join(10.0)
    until(lambda: received.endswith(STOP), doing=lambda: received.extend(line.read(0.05)))


def test_an_ended_link_leaves_no_file_open(line):
    def descriptors():
        return len(os.listdir('/proc/self/fd'))

    before = descriptors()
    for _ in range(3):
        link = McuLink(Port(line.path))
        link.start()
        until(lambda: link.port.is_open)
        link.stop()
        link.join(10.0)
    assert descriptors() <= before + 2 * 3      # of each a port's pipe
