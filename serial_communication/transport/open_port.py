"""An open port, one class a kind. `Port` has one from an opening to the next closing.

Its methods raise OSError if the port is gone; those with the names of `Port`'s do the same.
"""
import fcntl
import os
import select
import socket
import struct
import sys
import termios
import time
from contextlib import suppress
from typing import Optional

import serial

from . import tty_settings
from .port_errors import GONE, PortError
from .urls import NETWORK, read_url

_READ_SIZE = 4096      # so that a heartbeat never waits until a flood of bytes is decoded
_SLICE = 0.05      # s; longest read of pyserial's
_NOT_SENT = 0x894B     # SIOCOUTQNSD, which no Python module defines
_MOST_REFUSED = 3      # times in turn that a tty does not take its settings; then it keeps its own
_PULSE = 0.1       # s for which a control line is changed to reset a board
_VANISHED = 4      # s without an answer after which a connection's peer has vanished
_IAC = b'\xff'     # RFC 2217 is telnet, where this byte is doubled in data
_PTY = range(136, 144)               # major numbers of /dev/pts/*
_ACM = 166         # of /dev/ttyACM*, whose USB may have no line behind it


class OpenPort:
    """A file descriptor that is not blocking; the base of the other kinds.

    Args:
        wake: a descriptor that can be read after `Port.wake`.
    """

    is_pty = False
    has_baud = False     # whether its bytes were received at the baud rate

    def __init__(self, descriptor: int, wake: int) -> None:
        self._fd, self._wake = descriptor, wake
        self._poll = select.poll()
        self._poll.register(wake, select.POLLIN)

    def read(self, timeout: Optional[float], wants_room: bool) -> bytes:
        """As `Port.read`; with `wants_room` it also returns when the port can be written."""
        self._poll.register(self._fd, select.POLLIN | select.POLLOUT * wants_room)
        data = b''
        for descriptor, event in self._poll.poll(
                None if timeout is None else max(timeout * 1e3, 0.0)):
            if descriptor == self._wake:
                os.read(descriptor, _READ_SIZE)
            elif event != select.POLLOUT:
                with suppress(BlockingIOError):
                    data = os.read(self._fd, _READ_SIZE)
                    if not data:
                        raise PortError(GONE)
        return data

    def escaped(self, frame: bytes) -> bytes:
        """The bytes that carry a frame."""
        return frame

    def send(self, data: bytes) -> int:
        """Send what is taken at once; return how many bytes. BlockingIOError: none."""
        return os.write(self._fd, data)

    def unsent(self) -> int:
        """How many bytes wait in the kernel to be sent; 0: none, or unknown."""
        return self.on_its_way()

    def on_its_way(self) -> int:
        """The same, and those that the peer of a connection has not acknowledged."""
        return self._queued(termios.TIOCOUTQ)

    def changed_settings(self) -> bool:
        return False

    def renew(self, keeps_input: bool) -> int:
        return 0

    def pulse(self, line: str) -> None:
        raise PortError('the port has no control lines')

    def close(self) -> None:
        """Close it, and drop what is not sent."""

    def _queued(self, request: int) -> int:
        with suppress(OSError):
            return int.from_bytes(fcntl.ioctl(self._fd, request, bytes(4)), sys.byteorder)
        return 0


class OpenTty(OpenPort):
    """A tty, that is a serial device or a pseudo terminal: locked and raw."""

    def __init__(self, opened: serial.SerialBase, wake: int, reset: bool) -> None:
        super().__init__(opened.fileno(), wake)
        self._serial = opened
        major = os.major(os.fstat(self._fd).st_rdev)
        self.is_pty = major in _PTY
        self.has_baud = not self.is_pty and major != _ACM
        with suppress(AttributeError, OSError, ValueError, NotImplementedError):
            opened.set_low_latency_mode(True)   # else an FTDI chip holds data back for 16 ms
        if reset:       # a board whose reset line is connected to DTR
            with suppress(OSError, termios.error):
                self.pulse('dtr')
        # Locked also against programs that ignore pyserial's lock, except those of root. Of a
        # pseudo terminal the kernel would keep the lock for as long as the other end is open, so
        # after a SIGKILL this user could not open the port again.
        if not self.is_pty:
            self._lock(termios.TIOCEXCL)
        self._settings = b''        # which it should have; b'': unknown
        self._refused = 0           # how often in turn it did not take them
        # The ioctl has another number on some processors; pyserial's settings do there.
        with suppress(OSError, struct.error):
            self._settings = tty_settings.set_raw(self._fd, opened.baudrate)

    def _lock(self, request: int) -> None:
        with suppress(OSError):
            fcntl.ioctl(self._fd, request)

    def changed_settings(self) -> bool:
        with suppress(OSError):         # the device is gone; the next read reports it
            return bool(self._settings) and tty_settings.read(self._fd) != self._settings
        return False

    def renew(self, keeps_input: bool) -> int:
        waiting = 0 if keeps_input else self._queued(termios.FIONREAD)
        try:
            termios.tcflush(self._fd, termios.TCOFLUSH if keeps_input else termios.TCIOFLUSH)
            found = tty_settings.read(self._fd) if self._settings else b''
            if found != self._settings:
                tty_settings.write(self._fd, self._settings)
                # A device may refuse some of them: do not try for ever. But what is read back may
                # also be what another program has just set again.
                is_refused = tty_settings.read(self._fd) == found
                self._refused = self._refused + 1 if is_refused else 0
                if self._refused >= _MOST_REFUSED:
                    self._settings, self._refused = found, 0
        except (OSError, termios.error):
            pass        # the device is gone; the next read reports it
        return waiting

    def pulse(self, line: str) -> None:
        """Reset the board, as Arduino's programs do it by DTR, whose rise resets, and esptool by
        RTS, which resets while it is set and DTR is not."""
        is_rts = line == 'rts'
        self._serial.dtr = False
        if is_rts:
            self._serial.rts = True
        time.sleep(_PULSE)
        setattr(self._serial, line, not is_rts)

    def close(self) -> None:
        self._lock(termios.TIOCNXCL)    # it would last while any other program has the tty open
        self._serial.close()


class OpenSocket(OpenPort):
    """socket://, a TCP connection. It sends small packets at once, detects a peer that vanished,
    and when it is closed it drops what is not sent, which else would arrive later."""

    def __init__(self, opened: serial.SerialBase, wake: int) -> None:
        self._serial = opened
        self._socket = opened._socket       # pyserial has no public name for it
        super().__init__(self._socket.fileno(), wake)
        tcp = socket.IPPROTO_TCP
        for level, option, value in (
                (tcp, socket.TCP_NODELAY, 1), (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
                (tcp, socket.TCP_KEEPIDLE, 1), (tcp, socket.TCP_KEEPINTVL, 1),
                (tcp, socket.TCP_KEEPCNT, _VANISHED - 1),
                # mypy does not know this one.
                (tcp, socket.TCP_USER_TIMEOUT, _VANISHED * 1000)):  # type: ignore[attr-defined]
            self._socket.setsockopt(level, option, value)

    def unsent(self) -> int:
        return self._queued(_NOT_SENT)

    def close(self) -> None:
        if self.on_its_way():
            with suppress(OSError):     # already gone
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER,
                                        struct.pack('ii', 1, 0))     # resets it
        # pyserial's close would also sleep for 0.3 s, as long as a stall.
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._serial.is_open = False


class OpenRfc2217(OpenSocket):
    """rfc2217://, telnet with the settings of a serial port. pyserial reads it; what is written
    goes to its socket, since pyserial's write would block."""

    def read(self, timeout: Optional[float], wants_room: bool) -> bytes:
        with suppress(BlockingIOError):
            os.read(self._wake, _READ_SIZE)
        try:
            return bytes(self._serial.read(
                min(self._serial.in_waiting, _READ_SIZE) or int(timeout is None or timeout > 0)))
        except (AttributeError, TypeError):     # it is closed meanwhile
            raise PortError('the connection has gone') from None

    def close(self) -> None:
        super().close()
        pyserials = vars(self._serial)      # else its end would wait for its thread, and then sleep
        reader, pyserials['_thread'] = pyserials['_thread'], None
        if reader:
            reader.join(_SLICE)     # the closed socket ends it

    def escaped(self, frame: bytes) -> bytes:
        return frame.replace(_IAC, _IAC * 2)


def open_port(url: str, baud: int, wake: int, reset: bool) -> OpenPort:
    """Open a URL of pyserial's; OSError, ValueError or termios.error if that fails."""
    port = serial.serial_for_url(url, do_not_open=True)
    scheme = read_url(url)[1]
    if not isinstance(port, serial.Serial) and scheme not in NETWORK:
        raise PortError('only serial devices, socket:// and rfc2217:// can be opened')
    port.baudrate, port.timeout, port.exclusive = baud, _SLICE, True
    port.open()
    try:
        if scheme == 'socket':
            return OpenSocket(port, wake)
        return OpenRfc2217(port, wake) if scheme == 'rfc2217' else OpenTty(port, wake, reset)
    except BaseException:
        port.close()
        raise
