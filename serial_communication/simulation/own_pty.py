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

from ..transport.open_port import OpenPort
from ..transport.port import Port, PortError

_LOOK_AGAIN, _OTHERS = 0.01, 1.0     # s until other simulators, which end with this one, have ended


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
        tty.setraw(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
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
            with suppress(OSError):
                os.rmdir(self._made)
                self._made = ''
            time.sleep(_LOOK_AGAIN)

    def _open(self) -> OpenPort:
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        if any(event & select.POLLHUP for _, event in poll.poll(0)):
            raise PortError('waiting for a program that opens it')
        return _Master(self._master, self._name, self._wake_read)


class _Master(OpenPort):
    """The board's end, while another program has the other end open; else EIO is raised."""

    is_pty = True

    def __init__(self, master: int, name: str, wake: int) -> None:
        super().__init__(master, wake)
        self._name = name

    def close(self) -> None:
        """Drop what was written but not read."""
        super().close()
        with suppress(OSError, termios.error):
            termios.tcflush(self._fd, termios.TCOFLUSH)
            slave = os.open(self._name, os.O_RDWR | os.O_NOCTTY)
            termios.tcflush(slave, termios.TCIFLUSH)
            os.close(slave)
