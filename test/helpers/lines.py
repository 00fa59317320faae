"""Lines between a port of the bridge and a board of a test: real ttys, without hardware."""
import os
import pty
import select
import socket
import subprocess
import threading
import tty

import serial
import serial.rfc2217
from waiting import PATIENCE, until

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))


class Line:
    """A socat pair that can be unplugged and plugged in again.

    Args:
        near: the bridge's end.
        far: the board's end.
    """

    def __init__(self, near, far=None):
        self.near = str(near)
        self.far = str(far or self.near + '_board')
        self._process = None

    def plug(self):
        """Connect both ends."""
        for path in self.near, self.far:
            os.makedirs(os.path.dirname(path), exist_ok=True)
        self._process = subprocess.Popen(
            ['socat', *(f'pty,raw,echo=0,link={path}' for path in (self.near, self.far))],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(lambda: os.path.exists(self.near) and os.path.exists(self.far),
              'socat makes %s' % self.near)
        return self

    def unplug(self):
        """Disconnect both ends; both ports have vanished when this returns."""
        if self._process is None:
            return
        # The links first, so that they never point to a device that another program has got.
        for path in (self.near, self.far):
            if os.path.lexists(path):
                os.unlink(path)
        self._process.kill()
        self._process.wait(PATIENCE)
        self._process = None


class Pty:
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
        except OSError:
            return b''

    def read_all(self, quiet=0.1):
        """The bytes received until there are none for `quiet` s."""
        data = b''
        while True:
            part = self.read(quiet)
            if not part:
                return data
            data += part


class Tty:
    """The far end of a line, by its path. It is opened again when it has vanished and returned."""

    def __init__(self, path):
        self._path = path
        self._port = None
        self._writing = threading.Lock()

    @property
    def connected(self):
        """Whether it is open."""
        return self._port is not None

    def write(self, data):
        """Write bytes; False if it is closed."""
        with self._writing:
            try:
                self._port.write(data)
                return True
            except (OSError, AttributeError, TypeError):
                return False

    def read(self, seconds):
        """As `Pty.read`; OSError if there is no such tty now."""
        if self._port is None:
            # Exclusive, since another program may still use a link to a device that is now
            # another line's, and must not read this line's bytes.
            self._port = serial.Serial(self._path, 115200, exclusive=True)
        try:
            self._port.timeout = seconds
            return self._port.read(max(1, self._port.in_waiting))
        except (OSError, TypeError) as error:
            self.close()
            raise OSError('the line was cut') from error

    def close(self):
        port, self._port = self._port, None
        try:
            if port:
                port.close()
        except OSError:
            pass


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
