"""A serial port whose reads can be woken and whose writes never block.

A port is a device, or a connection that pyserial opens; `open_port` has the kinds.
"""
import glob
import os
import select
import termios
import threading
import time
from contextlib import suppress
from typing import Optional, Set

from .open_port import OpenPort, open_port
from .port_errors import PortBusy, PortError, explain
from .urls import NETWORK, identity, read_url

_HELD = 0.1             # s of wire time; a tty with more to send when it closes is held
_MOST_WAKES = 65536     # calls of `wake` that one read takes


class Port:
    """A path or a URL of pyserial's that can be opened any number of times; other programs are kept
    out. One thread opens, reads and closes; any thread may write or wake.

    `baud` is in bits per second. `reset_on_open` pulses DTR, which resets many boards.
    """

    RETRY = 0.3     # s until a simulated board tries to open it again

    def __init__(self, url: str, baud: int = 115200, reset_on_open: bool = False) -> None:
        self.url, scheme = read_url(url)
        self.baud = baud
        self.is_network = scheme in NETWORK     # it is on another computer
        self.bytes_received = 0
        self.bytes_sent = 0
        self._reset_on_open = reset_on_open
        self._opened: Optional[OpenPort] = None
        self._failure = ''               # why this opening was given up
        self._lock = threading.Lock()    # held to write, and at the end of an opening
        self._rest = b''                 # the unsent rest of a frame that the kernel took in part
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    @property
    def is_open(self) -> bool:
        return self._opened is not None

    @property
    def is_usable(self) -> bool:
        """Whether it is open, and not given up."""
        return self._opened is not None and not self._failure

    @property
    def hides(self) -> bool:
        """Whether it hides what it has not sent: a connection, or an open pseudo terminal."""
        opened = self._opened
        return self.is_network or opened is not None and opened.is_pty

    @property
    def byte_time(self) -> float:
        """s on the wire of a byte received; 0.0: not known."""
        opened = self._opened
        return 10.0 / self.baud if opened and opened.has_baud else 0.0

    def open(self) -> None:
        """Open the port; raise PortError with the reason if it cannot be opened now."""
        with self._lock:
            self._failure = ''      # `give_up` is in force although it comes during the opening
        try:
            opened = self._open()
        except (OSError, ValueError, termios.error) as error:
            raise PortError(explain(error)) from None
        with self._lock:
            self._rest, self._opened = b'', opened

    def _open(self) -> OpenPort:
        return open_port(self.url, self.baud, self._wake_read, self._reset_on_open)

    def is_used(self) -> bool:
        """Whether another program has the device open; False if that cannot be known."""
        path = identity(self.url)
        return isinstance(path, str) and bool(open_in(path) - {os.getpid()})

    def give_up(self, why: str) -> None:
        """Write nothing more until the port is opened again; the next `read` raises PortError,
        whose text is `why`."""
        with self._lock:
            self._failure = why
        self.wake()

    def renew(self, keeps_input: bool = False) -> int:
        """Drop what waits in both directions, and restore the settings of a tty; it stays open.

        Returns the number of bytes received that were dropped; with `keeps_input` these stay. A
        network port can drop nothing, a pseudo terminal not what its other side can read already.
        """
        with self._lock:
            self._rest = b''
            return self._opened.renew(keeps_input) if self._opened else 0

    def changed_settings(self) -> bool:
        """Whether another program has changed the settings of a tty."""
        return self._opened is not None and self._opened.changed_settings()

    def pulse(self, line: str) -> None:
        """Reset the board by the line `dtr` or `rts`; PortError if the port has no such lines."""
        opened = self._opened
        try:
            if opened is None:
                raise PortError('the port is closed')
            opened.pulse(line)
        except (OSError, termios.error) as error:
            raise PortError(explain(error)) from None

    def close(self) -> None:
        """Close the port; what the other side does not take is dropped."""
        with self._lock:
            is_held = bool(self._rest) or self.unsent() > self.baud / 10 * _HELD
            closing, self._opened = self._opened, None
            self._rest = b''
        if closing:
            with suppress(OSError, termios.error):
                if is_held:     # else a tty waits up to 30 s for the output to leave
                    closing.renew(keeps_input=False)
                closing.close()

    def pause(self, seconds: float) -> None:
        """Sleep for so long, or until `wake`, while the port is closed."""
        if select.select([self._wake_read], [], [], max(seconds, 0.0))[0]:
            with suppress(BlockingIOError):
                os.read(self._wake_read, _MOST_WAKES)

    def read(self, timeout: Optional[float]) -> bytes:
        """Sleep until bytes are received, and return them, at most 4096.

        Return b'' after `timeout` s (None: no limit) or `wake`, with rfc2217:// after 50 ms at the
        latest; raise PortError if the port is gone.
        """
        opened = self._opened
        if opened is None or self._failure:
            raise PortError(self._failure or 'the port is closed')
        try:
            data = opened.read(timeout, bool(self._rest))
            if self._rest:
                with self._lock, suppress(BlockingIOError):
                    self._rest = self._send(opened, self._rest)
        except OSError as error:
            raise PortError(explain(error)) from None
        self.bytes_received += len(data)
        return data

    def write(self, frame: bytes) -> None:
        """Write one whole frame; never blocks.

        If the kernel takes only a part of it, the rest is sent before any other frame, so frames
        are neither mixed nor cut. Raise PortBusy if the kernel takes nothing now, so nothing of
        this frame was sent, and PortError if the port is closed or gone.
        """
        with self._lock:
            opened = self._opened
            if opened is None or self._failure:
                raise PortError(self._failure or 'the port is closed')
            try:
                if self._rest:
                    self._rest = self._send(opened, self._rest)
                    if self._rest:
                        raise BlockingIOError
                self._rest = self._send(opened, opened.escaped(frame))
            except BlockingIOError:
                raise PortBusy('the port takes no data') from None
            except OSError as error:
                raise PortError(explain(error)) from None
            if self._rest:
                self.wake()

    def _send(self, opened: OpenPort, data: bytes) -> bytes:
        """Send what is taken at once; return the rest. BlockingIOError: nothing is taken."""
        sent = opened.send(data)
        self.bytes_sent += sent
        return data[sent:]

    def unsent(self) -> int:
        """How many written bytes wait here to be sent, as the driver reports it; 0 if unknown."""
        opened = self._opened
        return opened.unsent() + len(self._rest) if opened else 0

    def drain(self, seconds: float) -> None:
        """Wait, at most for so long, until all that was written has left, and a peer has it."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            opened = self._opened
            if opened is None or not opened.on_its_way() + len(self._rest):
                return
            time.sleep(0.002)

    def wake(self) -> None:
        """Make a sleeping `read` return, or the next one."""
        with suppress(BlockingIOError):     # the pipe is full of wake-ups already
            os.write(self._wake_write, b'.')


def open_in(path: str) -> Set[int]:
    """The processes that have a device open: those of this user, for root of all users; of a pseudo
    terminal without those that have the other end of one."""
    device, found, masters = os.path.realpath(path), set(), set()
    for descriptor in glob.iglob('/proc/[0-9]*/fd/*'):
        with suppress(OSError):     # closed meanwhile
            opened, pid = os.readlink(descriptor), int(descriptor.split('/')[2])
            if opened.endswith('/ptmx'):
                masters.add(pid)
            # In a container the same path may be another device.
            elif opened == device and os.path.samefile(descriptor, device):
                found.add(pid)
    return found - masters if device.startswith('/dev/pts/') else found
