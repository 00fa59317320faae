"""A serial port whose reads can be woken and whose writes never block.

A port is anything that pyserial opens; what only pyserial can read (rfc2217://, loop://) is read
in slices of 50 ms. `open_port` has the kinds.
"""
import glob
import os
import select
import termios
import threading
import time
from contextlib import suppress
from typing import Callable, NamedTuple, Optional, Set

import serial

from .open_port import OpenPort, open_port
from .pace import clock
from .port_errors import PortBusy, PortError, explain
from .urls import NETWORK, read_url

_MOST_WAKES = 65536     # calls of `wake` that one read takes
_STALLED = 0.1     # s of wire time; with a longer backlog a tty counts as held when it closes


class Loan(NamedTuple):
    """Another program has borrowed a port."""

    by: str          # who; for people
    until: float     # s; by the clock of the port

    def __str__(self) -> str:
        return f'lent to {self.by}'


class Port:
    """A path or a URL of pyserial's that can be opened any number of times; other programs are kept
    out. One thread opens, reads and closes; any thread may write or wake.

    `baud` is in bits per second. `reset_on_open` pulses DTR, which resets many boards. `now` is
    the clock of loans.
    """

    RETRY = 0.3     # s until a simulated board tries to open it again

    def __init__(self, url: str, baud: int = 115200, reset_on_open: bool = False,
                 now: Callable[[], float] = clock) -> None:
        self.url, self._scheme = read_url(url)
        # Whether the port is on another computer, which hides how much it has not sent.
        self.is_network = self._scheme in NETWORK
        self.is_pty = False              # the open port is a pseudo terminal, which hides it, too
        self.baud = baud
        self.byte_time = 0.0             # s on the wire of a byte received; 0.0: not known
        self.bytes_received = 0
        self.bytes_sent = 0
        self._reset_on_open = reset_on_open
        self._now = now
        self.loan: Optional[Loan] = None     # the port stays closed while it runs
        self._opened: Optional[OpenPort] = None
        self._failure = ''               # why this connection was given up
        self._lock = threading.Lock()    # held to write, to lend, and at the end of an opening
        self._rest = b''                 # the unsent rest of a frame that the kernel took in part
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    @property
    def is_open(self) -> bool:
        return self._opened is not None

    def open(self) -> None:
        """Open the port; raise PortError with the reason if it cannot be opened now."""
        try:
            opened = self._open()
        except (OSError, ValueError, termios.error) as error:
            raise PortError(explain(error)) from None
        with self._lock:
            self.is_pty = opened.is_pty
            self.byte_time = 10.0 / self.baud if opened.has_baud else 0.0
            self._rest, self._failure = b'', ''
            self._opened = opened

    def _open(self) -> OpenPort:
        port = serial.serial_for_url(self.url, do_not_open=True)
        self._refuse_while_lent(port.port or '')
        port.baudrate = self.baud
        return open_port(port, self._scheme, self._wake_read, self._reset_on_open)

    def _refuse_while_lent(self, path: str) -> None:
        """Raise PortError while a loan runs, and afterwards until no other program has the device
        open: an upload goes on if whoever renewed its loan was killed."""
        loan = self.loan
        if loan is None:
            return
        if self.is_lent:
            raise PortError(str(loan))
        if self._others_have(path):
            raise PortError(f'it was {loan}, and another program still has it open')
        self.loan = None

    @staticmethod
    def _others_have(path: str) -> bool:
        """Whether another program has the device open."""
        return bool(open_in(path) - {os.getpid()})

    @property
    def is_lent(self) -> bool:
        """Whether a loan runs."""
        loan = self.loan        # the link's thread may set it to None
        return loan is not None and self._now() < loan.until

    def give_up(self, why: str) -> None:
        """Write nothing more until the port is opened again; the next `read` raises PortError,
        whose text is `why`."""
        with self._lock:
            self._failure = why
        self.wake()

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
        """Close the port; what was written but not sent is dropped."""
        with self._lock:
            is_held = bool(self._rest) or self.backlog() > _STALLED
            closing, self._opened = self._opened, None
            self._rest = b''
        if closing:
            with suppress(OSError, termios.error):
                closing.close(is_held)

    def pause(self, seconds: float) -> None:
        """Sleep for so long, or until `wake`, while the port is closed."""
        if select.select([self._wake_read], [], [], max(seconds, 0.0))[0]:
            with suppress(BlockingIOError):
                os.read(self._wake_read, _MOST_WAKES)

    def read(self, timeout: Optional[float]) -> bytes:
        """Sleep until bytes are received, and return all of them.

        Return b'' after `timeout` s (None: no limit) or `wake`; raise PortError if the port is
        gone.
        """
        opened = self._opened
        if opened is None:
            raise PortError('the port is closed')
        try:
            data = opened.read(timeout, bool(self._rest))
            if self._rest:
                with self._lock, suppress(BlockingIOError):
                    self._rest = self._send(opened, self._rest)
        except OSError as error:
            raise PortError(explain(error)) from None
        if self._failure:
            raise PortError(self._failure)
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
                raise PortError(str(self.loan or self._failure or 'the port is closed'))
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

    def backlog(self) -> float:
        """The bytes that wait in the kernel to be sent, as s of wire time; 0.0 if unknown."""
        opened = self._opened
        return (opened.unsent() + len(self._rest)) * 10.0 / self.baud if opened else 0.0

    def on_its_way(self) -> bool:
        """Whether written bytes are not sent yet; for a connection, not yet acknowledged."""
        opened = self._opened
        return opened is not None and opened.on_its_way() + len(self._rest) > 0

    def drain(self, seconds: float) -> None:
        """Wait, at most for so long, until all that was written has left."""
        deadline = time.monotonic() + seconds
        while self.on_its_way() and time.monotonic() < deadline:
            time.sleep(0.002)

    def discard_output(self, why: str = 'the peer takes no data') -> bool:
        """Drop what was written but not sent; return whether the port is still usable.

        A connection cannot do that. It is given up instead, and the next `read` raises PortError,
        whose text is `why`. Of a pseudo terminal, up to 4095 bytes that its other side can read
        already stay there.
        """
        with self._lock:
            self._rest = b''
            if not self.is_network:
                if self._opened:
                    self._opened.discard_output()
                return True
            self._failure = why
        self.wake()
        return False

    def restore_settings(self) -> str:
        """Restore the settings of a tty if another program has changed them; return those, for
        people, or ''.

        Only the reading thread may call this. Bytes that wait to be read are dropped then, since
        the other settings may have changed them.
        """
        return self._opened.restore_settings() if self._opened else ''

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
