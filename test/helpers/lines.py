"""Lines between a port of the bridge and a board of a test: real ttys, without hardware."""
import os
import pty
import select
import subprocess
import tty

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
