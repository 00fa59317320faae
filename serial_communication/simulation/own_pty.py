"""The port of a simulated board on a pseudo terminal of its own.

The board has the master; a bridge opens the other end, by its name or by a link. The simulator does
not keep that end open itself. So it sees a hang-up when the bridge closes it, and then neither
writes nor leaves anything that the next bridge would read as new.
"""
import os
import select
import termios
import time
import tty
from contextlib import suppress
from typing import Optional

from ..transport.port import Port, PortBusy, PortError

_LOOK_AGAIN = 0.01     # s
_READ_SIZE = 65536
_OTHERS = 1.0          # s until other simulators, which are ended with this one, have ended


class OwnPty(Port):
    """A port that is open while another program has the other end open.

    Args:
        link: the path of a link to the other end. A link to another pseudo terminal, as a killed
            simulator leaves it, is replaced; a folder that is absent is made. '': no link.

    Raises:
        OSError: the link cannot be made.
    """

    RETRY = 0.01     # s; the kernel does not tell the master that the other end was opened

    def __init__(self, link: str = '') -> None:
        self._master, slave = os.openpty()
        self._name = os.ttyname(slave)
        super().__init__(link or self._name)
        self._link = link
        self._has_opened = False
        tty.setraw(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        self._made = ''        # the folder of the link, if this program has made it
        if link:
            folder = os.path.dirname(os.path.abspath(link))
            with suppress(FileExistsError):
                os.makedirs(folder)
                self._made = folder
            if os.path.islink(link) and os.readlink(link).startswith('/dev/pts/'):
                os.unlink(link)
            os.symlink(self._name, link)

    def remove(self) -> None:
        """Remove the link, unless it leads elsewhere by now, and a folder that was made for it."""
        with suppress(OSError):
            if os.readlink(self._link) == self._name:
                os.unlink(self._link)
        end = time.monotonic() + _OTHERS
        while self._made and time.monotonic() < end:
            try:
                os.rmdir(self._made)
                return
            except OSError:
                time.sleep(_LOOK_AGAIN)

    @property
    def is_open(self) -> bool:
        return self._has_opened

    def open(self) -> None:
        """PortError while no other program has the other end open."""
        if any(event & select.POLLHUP for _, event in self._poll.poll(0)):
            raise PortError('waiting for a program that opens it')
        self._has_opened = True

    def close(self) -> None:
        """Drop what was written but not read."""
        self._has_opened = False
        self._rest = b''
        with suppress(OSError, termios.error):
            termios.tcflush(self._master, termios.TCOFLUSH)
            slave = os.open(self._name, os.O_RDWR | os.O_NOCTTY)
            termios.tcflush(slave, termios.TCIFLUSH)
            os.close(slave)

    def read(self, timeout: Optional[float]) -> bytes:
        waiting = [self._master] if self._rest else []
        ready, writable, _ = select.select([self._master, self._wake_read], waiting, [], timeout)
        try:
            if self._wake_read in ready:
                os.read(self._wake_read, _READ_SIZE)
            if writable:
                self._rest = self._rest[os.write(self._master, self._rest):]
            return os.read(self._master, _READ_SIZE) if self._master in ready else b''
        except BlockingIOError:
            return b''
        except OSError:
            raise PortError('the other program has closed it') from None

    def write(self, frame: bytes) -> None:
        if not self._has_opened:
            raise PortError('no program has opened it')
        try:
            if self._rest:
                self._rest = self._rest[os.write(self._master, self._rest):]
            if self._rest:
                raise BlockingIOError
            self._rest = frame[os.write(self._master, frame):]
        except BlockingIOError:
            raise PortBusy('the port takes no data') from None
        except OSError:
            raise PortError('the other program has closed it') from None
