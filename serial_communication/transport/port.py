"""A serial port whose reads can be woken and whose writes never block.

A port is anything that pyserial opens. If it has a file descriptor (devices, socket://), reading
sleeps in poll() until a byte is received. Other kinds (rfc2217://, loop://) are read in slices of
50 ms. Writing hands over what the kernel takes at once.

A connection (socket://, rfc2217://) detects a peer that vanished. What it has not sent when it is
closed is dropped, not delivered later.
"""
import argparse
import errno
import fcntl
import grp
import io
import os
import pwd
import re
import select
import socket
import struct
import termios
import threading
import time
from typing import Callable, Optional, Tuple
from urllib.parse import urlsplit

import serial

from . import devices, tty_settings
from .holders import holders_of

_READ_SIZE = 65536
_READABLE = select.POLLIN | select.POLLHUP | select.POLLERR
_SLICE = 0.05      # s; longest wait of pyserial's reads and writes
_STALLED = 0.1     # s of wire time; with a longer backlog a tty counts as held when it closes
_NOT_SENT = 0x894B     # SIOCOUTQNSD, which no Python module defines
NETWORK = 'socket', 'rfc2217'       # the schemes with a host
_VANISHED = 4      # s without an answer after which a connection's peer has vanished
_LOOK_AGAIN = 10.0  # s for which the program that has the port open is not looked up again
_IAC = b'\xff'     # RFC 2217 is telnet, where this byte is doubled in data
_PTMX = os.makedev(5, 2)             # /dev/ptmx
_PTY = range(136, 144)               # major numbers of /dev/pts/*


class PortError(Exception):
    """The port cannot be opened, or is gone; the text is for people."""


class PortBusy(Exception):
    """The port takes no bytes now; nothing of this write was sent."""


def read_url(url: str) -> Tuple[str, str]:
    """A port's URL with its scheme in lower case, and that scheme; '' for a path.

    pyserial accepts schemes in any case, so every comparison of schemes has to use this one.
    """
    scheme, found, rest = url.partition('://')
    return (scheme.lower() + found + rest, scheme.lower()) if found else (url, '')


def check_url(url: str) -> None:
    """Raise ValueError for a URL that can never be opened; the text says why. Opens nothing."""
    url, scheme = read_url(url)
    try:
        port = serial.serial_for_url(url, do_not_open=True)
    except serial.SerialException:
        return    # a valid URL whose device is absent (hwgrep://)
    except re.error as error:
        raise ValueError(f'hwgrep:// takes a regular expression: {error}') from None
    if scheme in NETWORK:
        _check_network_url(url, port)
    _check_device(port.port)


def url_argument(text: str) -> str:
    """For argparse: a device or URL that pyserial may be able to open."""
    try:
        check_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text}: {error}') from None
    return text


def _check_device(path: str) -> None:
    try:
        device = os.stat(path).st_rdev
    except (OSError, TypeError, ValueError):
        return      # absent, or not a path
    if device == _PTMX:
        raise ValueError(f'{path} makes a new pseudo terminal at each opening, which no other '
                         'program has; name an existing one, as in /dev/pts/3')


def _check_network_url(url: str, port: serial.SerialBase) -> None:
    parts = urlsplit(url)
    form = f'{parts.scheme}:// takes a host and a port, as in {parts.scheme}://192.168.1.5:4001'
    try:
        number = parts.port
    except ValueError:
        number = 0
    if not parts.hostname or not number:
        wrong = ('the host is missing' if not parts.hostname else
                 'the port is missing' if number is None else
                 'the port is out of range (1 … 65535)')
        raise ValueError(f'{form}; {wrong}')
    try:
        port.from_url(url)
    except (ValueError, KeyError, OSError):    # pyserial's texts for this are unusable
        raise ValueError(f'{form}; "?{parts.query}" is not an option of it') from None


class Port:
    """A port that can be opened and closed any number of times; other programs are kept out.

    One thread opens, reads and closes; any thread may write or wake.

    Args:
        url: a path, or a URL as pyserial has it.
        baud: bits per second.
        reset_on_open: pulse DTR at each opening, which resets many boards.
    """

    def __init__(self, url: str, baud: int = 115200, reset_on_open: bool = False) -> None:
        self.url, self._scheme = read_url(url)
        # Whether the port is on another computer, which hides how much it has not sent.
        self.is_network = self._scheme in NETWORK
        self.is_pty = False              # the open port is a pseudo terminal, which hides it, too
        self.baud = baud
        self.bytes_received = 0
        self.bytes_sent = 0
        self._reset_on_open = reset_on_open
        self._serial: Optional[serial.SerialBase] = None
        self._fd = -1                    # to poll and read; -1: closed, or there is none
        self._out = -1                   # to write to; -1: closed, or there is none
        self._settings = b''             # which the tty should have; b'': not a tty
        self._failure = ''               # why this connection was given up
        self._in_use = ('', '', 0.0)     # path, who has it open, when to look again (monotonic)
        self._lock = threading.Lock()    # held to write, open and close
        self._rest = b''                 # the unsent rest of a frame that the kernel took in part
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._poll = select.poll()
        self._polls_output = False       # whether `_poll` also waits for room to write

    @property
    def is_open(self) -> bool:
        return self._serial is not None

    def open(self) -> None:
        """Open the port.

        Raises:
            PortError: it cannot be opened now; the text says why.
        """
        path = ''
        try:
            opened = serial.serial_for_url(self.url, do_not_open=True)
            path = opened.port or ''
            _check_device(path)
            opened.baudrate = self.baud
            opened.timeout = _SLICE
            if self._scheme != 'rfc2217':     # which has no write timeout
                opened.write_timeout = _SLICE
            if self._scheme not in NETWORK + ('loop',):
                opened.exclusive = True
            opened.open()
        except (OSError, ValueError, termios.error) as error:
            raise PortError(_explain(error, path, self._who_has_it_open)) from None
        try:
            fd = opened.fileno()
        except (io.UnsupportedOperation, AttributeError):
            fd = -1
        out = fd
        settings = b''
        if self.is_network:
            try:
                out = self._set_up_connection(opened)
            except OSError as error:
                opened.close()
                raise PortError(_explain(error)) from None
        elif fd >= 0 and os.isatty(fd):
            settings = self._set_up_tty(opened, fd)
        self._poll = select.poll()
        self._polls_output = False
        self._poll.register(self._wake_read, select.POLLIN)
        if fd >= 0:
            self._poll.register(fd, select.POLLIN)
        with self._lock:
            self.is_pty = _is_pty(fd)
            self._rest = b''
            self._failure = ''
            self._in_use = ('', '', 0.0)
            self._settings = settings
            self._fd = fd
            self._out = out
            self._serial = opened

    def _who_has_it_open(self, path: str) -> str:
        """Looked up at most every `_LOOK_AGAIN` s: it reads the open files of all processes."""
        now = time.monotonic()
        if path != self._in_use[0] or now >= self._in_use[2]:
            self._in_use = path, _who_has_it_open(path), now + _LOOK_AGAIN
        return self._in_use[1]

    def close(self) -> None:
        """Close the port; what was written but not sent is dropped."""
        with self._lock:
            stalled = self.backlog() > _STALLED or self._rest
            unsent = self.on_its_way()
            closing, self._serial = self._serial, None
            out, self._out = self._out, -1
            self._fd = -1
            self._rest = b''
        if closing is None:
            return
        try:
            if self.is_network:
                # Else the kernel goes on sending for minutes, and the board gets old commands.
                if unsent:
                    _drop_as_it_closes(closing)
            elif out >= 0 and stalled:
                # Closing a tty waits up to 30 s for its output to drain: drop what is held.
                _flush_output(out)
            _let_others_open(out)
            closing.close()
        except (OSError, termios.error):
            pass

    def read(self, timeout: Optional[float]) -> bytes:
        """Sleep until bytes are received, and return all of them.

        Args:
            timeout: s; None: no limit.

        Returns:
            b'' after the timeout or `wake`.

        Raises:
            PortError: the port is gone.
        """
        if self._fd < 0:
            return self._read_sliced(timeout)
        fd = self._fd
        if self._failure:
            raise PortError(self._failure)
        milliseconds = None if timeout is None else max(timeout, 0) * 1000
        try:
            if bool(self._rest) != self._polls_output:
                self._polls_output = bool(self._rest)
                self._poll.modify(fd, select.POLLIN | select.POLLOUT if self._polls_output
                                  else select.POLLIN)
            ready = self._poll.poll(milliseconds)
            data = b''
            for descriptor, event in ready:
                if descriptor == self._wake_read:
                    os.read(self._wake_read, _READ_SIZE)
                    continue
                if event & _READABLE:
                    data = os.read(fd, _READ_SIZE)
                    if not data:
                        raise PortError('the device has gone')
                if event & select.POLLNVAL:
                    raise PortError('the device has gone')
                if event & select.POLLOUT:
                    with self._lock:
                        self._send_rest()
            if self._failure:
                raise PortError(self._failure)
        except BlockingIOError:
            return b''
        except OSError as error:
            raise PortError(_explain(error)) from None
        self.bytes_received += len(data)
        return data

    def _read_sliced(self, timeout: Optional[float]) -> bytes:
        deadline = None if timeout is None else time.monotonic() + timeout
        port = self._serial
        if port is None:
            raise PortError('the port is closed')
        try:
            while True:
                if self._failure:
                    raise PortError(self._failure)
                if self._rest:
                    with self._lock:
                        self._send_rest()
                waiting = min(port.in_waiting, _READ_SIZE)
                data = port.read(max(waiting, 1) if waiting or deadline is None
                                 or deadline > time.monotonic() else 0)
                woken = bool(self._poll.poll(0))
                if woken:
                    os.read(self._wake_read, _READ_SIZE)
                if data or woken or (deadline is not None and time.monotonic() >= deadline):
                    self.bytes_received += len(data)
                    return data
        except (OSError, AttributeError, TypeError) as error:
            raise PortError(_explain(error)) from None

    def write(self, frame: bytes) -> None:
        """Write one whole frame; never blocks.

        If the kernel takes only a part of it, the rest is sent before any other frame, so frames
        are neither mixed nor cut.

        Raises:
            PortBusy: the kernel takes nothing now; nothing of this frame was sent.
            PortError: the port is closed or gone.
        """
        with self._lock:
            if self._serial is None:
                raise PortError('the port is closed')
            if self._failure:
                raise PortError(self._failure)
            try:
                if self._out < 0:       # loop://
                    self._serial.write(frame)
                    self.bytes_sent += len(frame)
                    return
                if self._fd < 0:        # rfc2217:// by its socket: pyserial's write would block
                    frame = frame.replace(_IAC, _IAC * 2)
                if self._rest:
                    self._send_rest()
                    if self._rest:
                        raise PortBusy('the port takes no data')
                sent = os.write(self._out, frame)
            except BlockingIOError:
                raise PortBusy('the port takes no data') from None
            except OSError as error:
                raise PortError(_explain(error)) from None
            self.bytes_sent += sent
            if sent < len(frame):
                self._rest = frame[sent:]
                self.wake()

    def _send_rest(self) -> None:
        try:
            sent = os.write(self._out, self._rest)
        except BlockingIOError:
            return
        self.bytes_sent += sent
        self._rest = self._rest[sent:]

    def backlog(self) -> float:
        """The bytes that wait in the kernel to be sent, as s of wire time; 0.0 if unknown."""
        return self._waiting(_NOT_SENT if self.is_network else termios.TIOCOUTQ)

    def on_its_way(self) -> bool:
        """Whether written bytes are not sent yet; for a connection, not yet acknowledged."""
        return self._waiting(termios.TIOCOUTQ) > 0

    def _waiting(self, queue: int) -> float:
        out = self._out
        if out < 0:
            return 0.0
        try:
            waiting = struct.unpack('i', fcntl.ioctl(out, queue, b'\0\0\0\0'))[0]
        except OSError:
            waiting = 0
        return (waiting + len(self._rest)) * 10.0 / self.baud

    def discard_output(self, why: str = 'the peer takes no data') -> bool:
        """Drop what was written but not sent.

        A connection cannot do that. It is given up instead, and the next `read` raises PortError.
        Of a pseudo terminal, up to 4095 bytes that its other side can read already stay there.

        Args:
            why: the text of that error.

        Returns:
            whether the port is still usable.
        """
        with self._lock:
            self._rest = b''
            if not self.is_network:
                if self._out >= 0:
                    _flush_output(self._out)
                return True
            self._failure = why
        self.wake()
        return False

    def restore_settings(self) -> str:
        """Restore the settings of a tty if another program has changed them.

        Only the reading thread may call this. Bytes that wait to be read are dropped then, since
        the other settings may have changed them.

        Returns:
            the changed settings, for people; '' if there are none.
        """
        wanted, fd = self._settings, self._fd
        if not wanted or fd < 0:
            return ''
        try:
            found = tty_settings.read(fd)
            if found == wanted:
                return ''
            tty_settings.write(fd, wanted)
            # Read back, since a device may refuse some of them: do not try again each time.
            self._settings = tty_settings.read(fd)
            termios.tcflush(fd, termios.TCIFLUSH)
        except (OSError, termios.error):
            return ''       # the device is gone; the next read reports it
        return tty_settings.changes(wanted, found)

    def wake(self) -> None:
        """Make a sleeping `read` return, or the next one."""
        try:
            os.write(self._wake_write, b'.')
        except BlockingIOError:
            pass    # the pipe is full of wake-ups already

    @staticmethod
    def _set_up_connection(opened: serial.SerialBase) -> int:
        """Send small packets at once and detect a vanished peer; return its descriptor."""
        connection = _socket_of(opened)
        tcp = socket.IPPROTO_TCP
        for level, option, value in (
                (tcp, socket.TCP_NODELAY, 1), (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
                (tcp, socket.TCP_KEEPIDLE, 1), (tcp, socket.TCP_KEEPINTVL, 1),
                (tcp, socket.TCP_KEEPCNT, _VANISHED - 1),
                # mypy does not know this one.
                (tcp, socket.TCP_USER_TIMEOUT, _VANISHED * 1000)):  # type: ignore[attr-defined]
            connection.setsockopt(level, option, value)
        return connection.fileno()

    def _set_up_tty(self, opened: serial.SerialBase, fd: int) -> bytes:
        """Set up what pyserial does not; return the settings, or b'' if they are unknown."""
        try:
            opened.set_low_latency_mode(True)   # else an FTDI chip holds data back for 16 ms
        except (AttributeError, OSError, ValueError, NotImplementedError):
            pass
        try:
            if self._reset_on_open:
                opened.dtr = False
                time.sleep(0.05)
                opened.dtr = True
        except (OSError, termios.error):
            pass
        _keep_others_out(fd)
        try:
            return tty_settings.set_raw(fd, self.baud)
        except (OSError, struct.error):
            return b''      # the ioctl has another number on this processor; pyserial's settings do


def _keep_others_out(fd: int) -> None:
    """Lock the tty also against programs that ignore pyserial's lock, except those of root.

    A pseudo terminal is left unlocked. The kernel would keep the lock for as long as the other end
    is open, so after a SIGKILL this user could not open the port again.
    """
    if _is_pty(fd):
        return
    try:
        fcntl.ioctl(fd, termios.TIOCEXCL)
    except OSError:
        pass


def _is_pty(fd: int) -> bool:
    try:
        return os.major(os.fstat(fd).st_rdev) in _PTY
    except OSError:
        return False


def _let_others_open(fd: int) -> None:
    """Unlock the tty: the lock would stay while any other program has the tty open."""
    if fd < 0:
        return
    try:
        fcntl.ioctl(fd, termios.TIOCNXCL)
    except OSError:
        pass    # not a tty, or gone


def _socket_of(connection: serial.SerialBase) -> socket.socket:
    return connection._socket       # pyserial has no public name for it


def _drop_as_it_closes(connection: serial.SerialBase) -> None:
    """Make closing reset the connection, which drops its unsent bytes."""
    try:
        _socket_of(connection).setsockopt(socket.SOL_SOCKET, socket.SO_LINGER,
                                          struct.pack('ii', 1, 0))
    except (OSError, AttributeError):
        pass    # already gone


def _flush_output(fd: int) -> None:
    try:
        termios.tcflush(fd, termios.TCOFLUSH)
    except (OSError, termios.error):
        pass    # not a tty


_HINTS = {
    errno.ENOENT: 'there is no such device; waiting for it',
    errno.ENXIO: 'there is no such device; waiting for it',
    errno.ENODEV: 'the device has gone',
    errno.EIO: 'the device has gone',
    errno.EPERM: 'permission denied',
    errno.EBUSY: 'another program has it open',
    errno.EAGAIN: 'another program has it open',
    errno.EISDIR: 'this is a directory, not a serial port',
    errno.ENOTTY: 'this is not a serial port',
    errno.ECONNREFUSED: 'connection refused; does the server run, and is its port right?',
    errno.ECONNRESET: 'the other side closed the connection',
    errno.EPIPE: 'the other side closed the connection',
    errno.ETIMEDOUT: 'the host does not answer',
    errno.EHOSTUNREACH: 'the host cannot be reached',
    errno.ENETUNREACH: 'the host cannot be reached; is the network up?',
}

# Parts of pyserial's error texts, and their meaning.
_TEXTS = (
    ('Inappropriate ioctl', _HINTS[errno.ENOTTY]),
    ('does not seem to support RFC2217', 'the other side does not speak RFC 2217; '
                                         'socket:// is for a plain TCP connection'),
    ('while waiting for option', 'the other side does not speak RFC 2217; '
                                 'socket:// is for a plain TCP connection'),
    ('rejected value for option', 'the other side refuses the baud rate or another setting'),
    ('socket disconnected', 'the other side closed the connection'),
    ('connection failed', 'the other side closed the connection'),
    ('timed out', 'the host does not answer'),
    ('no ports found', 'no device matches; waiting for one'),
    ('that is not open', 'the device has gone'),
)


def _who_may_open(path: str) -> str:
    """Why permission to open this device was denied, and how to get it."""
    try:
        status = os.stat(path)
        group, owner = grp.getgrgid(status.st_gid).gr_name, pwd.getpwuid(status.st_uid).pw_name
    except (OSError, KeyError):     # an unreadable folder, or a user or group without a name
        return 'permission denied'
    if status.st_mode & 0o060 == 0o060 and group != 'root':
        return ('permission denied; join the group that owns it '
                f'(sudo usermod -a -G {group} $USER) and log in again')
    return (f'permission denied; only {owner} may open it: a udev rule can give it to a group, '
            'as in config/99-serial_communication.rules')


def _what_is_there(path: str) -> str:
    """The devices that are there instead of an absent one, for people."""
    for meant in os.path.join('/dev', path), '/' + path:
        if path[:1] != '/' and os.path.exists(meant):
            return f'; did you mean {meant}?'
    if '/' in path and not path.startswith('/dev/'):
        return ''     # not a device but a link, as of a simulated board
    there = devices.paths()
    return f"; this computer has {', '.join(there) or 'no serial port'}"


def _who_has_it_open(path: str) -> str:
    holders = holders_of(path)
    if [holder.pid for holder in holders] == [os.getpid()]:
        return f'this program itself has it open (pid {os.getpid()})'
    if not holders:
        return f'{_HINTS[errno.EBUSY]}, of another user: `sudo fuser -v {path}` names it'
    return f'{_HINTS[errno.EBUSY]}: {", ".join(map(str, holders))}'


def _explain(error: BaseException, path: str = '',
             who_has_it_open: Callable[[str], str] = _who_has_it_open) -> str:
    """What is wrong, for people, and what to do about it if that is known.

    Args:
        path: of the device, if it is one.
    """
    if isinstance(error, (AttributeError, TypeError)):
        return 'the connection has gone'     # pyserial raises these if it is closed during a read
    cause: Optional[BaseException] = error
    while cause is not None:      # pyserial hides the system's error behind its own
        if isinstance(cause, socket.gaierror):
            return 'no host of that name is known'
        if isinstance(cause, (OSError, termios.error)) and cause.args:
            number = cause.args[0]
            if path and number in (errno.EBUSY, errno.EAGAIN):
                return who_has_it_open(path)
            if path and number == errno.ENOENT:
                return _HINTS[number] + _what_is_there(path)
            hint = _who_may_open(path) if number == errno.EACCES else _HINTS.get(number)
            if hint:
                return hint
        cause = cause.__context__
    for part, meaning in _TEXTS:
        if part in str(error):
            return meaning
    return str(error)
