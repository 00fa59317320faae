"""The board's end of a link's port, for tests: a real tty, and boards that a test controls.

The boards are much simpler than the simulated ones, so that a test shows all that they do.
"""
import os
import pty
import select
import socket
import threading
import time
import tty
from contextlib import contextmanager
from functools import partial

import serial
import serial.rfc2217
import waiting
from fake_bus import FakeBus

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus

PATIENCE = 8.0      # s that a condition may take on the slowest machine
until = partial(waiting.until, seconds=PATIENCE, every=0.002)


class Line:
    """A pseudo terminal with a fixed path; it can vanish, and return as another device."""

    def __init__(self, path):
        self.path = str(path)
        self.fd = -1

    def plug(self):
        self.fd, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self.fd, False)
        new = self.path + '.new'
        os.symlink(os.ttyname(slave), new)
        os.replace(new, self.path)
        self._slave = slave       # kept open: else a closed port would be a hang-up here
        return self

    def unplug(self):
        if self.fd >= 0:
            os.unlink(self.path)
            os.close(self._slave)
            fd, self.fd = self.fd, -1
            os.close(fd)

    def write(self, data):
        """Write all of it; the other end has to read."""
        while data:
            _, writable, _ = select.select([], [self.fd], [], PATIENCE)
            assert writable, 'nobody reads'
            data = data[os.write(self.fd, data):]

    def read(self, seconds=0.0):
        """The bytes received, or the first ones within `seconds`; b'': none."""
        readable, _, _ = select.select([self.fd], [], [], seconds)
        try:
            return os.read(self.fd, 65536) if readable else b''
        except (BlockingIOError, OSError):
            return b''

    def read_all(self, quiet=0.1):
        """The bytes received until there are none for `quiet` s."""
        data = b''
        while True:
            part = self.read(quiet)
            if not part:
                return data
            data += part


class Board:
    """A thread that decodes received bytes and calls `take` with each valid frame."""

    def __init__(self, line, decoder, name):
        self.line = line
        self.seen = []             # frames, with the time of each in `stamp`
        self._decoder = decoder
        self._ending = threading.Event()
        self._paused = threading.Event()
        self._idle = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def messages(self, kind=None):
        """The messages received so far."""
        return [frame.message for frame in list(self.seen)
                if kind is None or isinstance(frame.message, kind)]

    def take(self, frame):
        """A valid frame was received; for subclasses."""

    def idle(self):
        """Called about a hundred times a second; for subclasses."""

    def start(self):
        self._thread.start()
        return self

    def stop(self):
        self._ending.set()
        self._thread.join(1.0)

    @contextmanager
    def unplugged(self):
        """Context in which the port is absent."""
        self._paused.set()
        assert self._idle.wait(PATIENCE)
        self.line.unplug()
        yield
        self.line.plug()
        self._idle.clear()
        self._paused.clear()

    def _run(self):
        while not self._ending.is_set():
            if self._paused.is_set():
                self._decoder.reset()
                self._idle.set()
                self._ending.wait(0.002)
                continue
            data = self.line.read(0.005)
            for frame in self._decoder.feed(data, time.monotonic()):
                if not frame.cause:
                    self.seen.append(frame)
                    self.take(frame)
            self.idle()


class BusBoard(FakeBus, Board):
    """The main control board."""

    def __init__(self, line, **manners):
        FakeBus.__init__(self, **manners)
        Board.__init__(self, line, bus.RequestDecoder(), 'bus board')
        self.write = line.write

    def requests(self, cmd1=None):
        return [request for request in self.messages() if cmd1 in (None, request.cmd1)]

    def moves(self):
        """Lift, gimbal and raw requests, in their order."""
        return [request for request in self.requests(bus.FUNCTION)
                if request != bus.ENVIRONMENT_REQUEST]


class CarBoard(Board):
    """Records what it receives; with `streaming` it sends IMU packets as fast as possible.

    Its speed is 0 at first. A SPEED 0 while the speed is 0 is a repetition: `seen` has it,
    `commands` does not.
    """

    IMU = arduino.encode(arduino.Imu(16384, *[0] * 10))

    def __init__(self, line, messages=()):
        super().__init__(line, arduino.BoardDecoder(messages=messages), 'car board')
        self.streaming = False
        self._commands = []
        self._speed = 0

    def take(self, frame):
        message = frame.message
        if isinstance(message, arduino.SpeedCommand):
            before, self._speed = self._speed, message.value
            if before == message.value == 0:
                return
        if not isinstance(message, arduino.Heartbeat):
            self._commands.append(message)

    def idle(self):
        if self.streaming:
            self.line.write(self.IMU)

    def heartbeats(self):
        return len(self.messages(arduino.Heartbeat))

    def commands(self):
        """All messages but heartbeats and repetitions of SPEED 0."""
        return list(self._commands)

    def forget(self):
        """Clear the records."""
        del self.seen[:], self._commands[:]


class Rfc2217Server:
    """A server for one connection, or a few, one after the other. Later ones are refused at once,
    so that no link still waits for an answer when a test ends."""

    def __init__(self, listening, path, connections=1):
        self.url = 'rfc2217://127.0.0.1:%d' % listening.getsockname()[1]
        self.peer = None
        self._going = threading.Event()
        self._going.set()
        self._standing = threading.Event()
        self._ended = threading.Event()
        self._server, self._path, self._connections = listening, path, connections
        self._thread = threading.Thread(target=self._serve, name='rfc2217 server', daemon=True)
        self._thread.start()

    @property
    def alive(self):
        return self._thread.is_alive()

    def stop_reading(self):
        """Stop reading; it has stopped when this returns, until `go_on`."""
        self._standing.clear()
        self._going.clear()
        assert self._standing.wait(PATIENCE)

    def go_on(self):
        self._going.set()

    def end(self):
        self._ended.set()
        self._going.set()
        self._thread.join()

    def _serve(self):
        with self._server:
            for _ in range(self._connections - 1):
                self.peer, _ = self._server.accept()
                self._serve_peer()
            self.peer, _ = self._server.accept()
        self._serve_peer()

    def _serve_peer(self):
        connection = _Connection(self.peer)
        with self.peer, _Device(self._path, timeout=0.05) as device:
            manager = serial.rfc2217.PortManager(device, connection)
            self.peer.settimeout(0.05)
            while not self._ended.is_set():
                if not self._going.is_set():
                    self._standing.set()
                    self._going.wait()
                    continue
                connection.write(b''.join(manager.escape(device.read(device.in_waiting))))
                try:
                    data = self.peer.recv(65536)
                except socket.timeout:
                    continue
                except OSError:
                    break
                if not data:
                    break       # closed, not reset: the peer knew that all had arrived
                device.write(b''.join(manager.filter(data)))


class _Device(serial.Serial):
    """A pseudo terminal, which has no modem lines."""

    cts = dsr = ri = cd = False
    rts = dtr = True


class _Connection:
    """What a PortManager writes its answers to."""

    def __init__(self, peer):
        self._peer = peer

    def write(self, data):
        try:
            self._peer.sendall(data)
        except OSError:
            pass    # the peer no longer reads; what it sent can still be read
