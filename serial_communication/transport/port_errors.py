"""What is wrong with a port, in words for people."""
import errno
import socket
import termios
from typing import Iterator, Optional


class PortError(Exception):
    """The port cannot be opened, or is gone; the text is for people."""


class PortBusy(Exception):
    """The port takes no bytes now; nothing of this write was sent."""


GONE = 'the device has gone'
_ABSENT = 'there is no such device; waiting for it'
_IN_USE = 'another program has it open; `rosrun serial_communication ports` names it'
_DENIED = 'permission denied; `rosrun serial_communication ports` has the remedy'
_CLOSED = 'the other side closed the connection'
_NO_ANSWER = 'the host does not answer'
_NO_RFC2217 = 'the other side does not speak RFC 2217; socket:// is for a plain TCP connection'
_NO_PORT = 'this is not a serial port'

_HINTS = {
    errno.ENOENT: _ABSENT,
    errno.ENXIO: _ABSENT,
    errno.ENODEV: GONE,
    errno.EIO: GONE,
    errno.EACCES: _DENIED,
    errno.EPERM: _DENIED,
    errno.EBUSY: _IN_USE,
    errno.EAGAIN: _IN_USE,
    errno.EISDIR: 'this is a directory, not a serial port',
    errno.ENOTTY: _NO_PORT,
    errno.ECONNREFUSED: 'connection refused; does the server run, and is its port right?',
    errno.ECONNRESET: _CLOSED,
    errno.EPIPE: _CLOSED,
    errno.ETIMEDOUT: _NO_ANSWER,
    errno.EHOSTUNREACH: 'the host cannot be reached',
    errno.ENETUNREACH: 'the host cannot be reached; is the network up?',
}

# Parts of pyserial's error texts, and their meaning.
_TEXTS = {
    'Inappropriate ioctl': _NO_PORT,
    'does not seem to support RFC2217': _NO_RFC2217,
    'while waiting for option': _NO_RFC2217,
    'rejected value for option': 'the other side refuses the baud rate or another setting',
    'socket disconnected': _CLOSED,
    'connection failed': _CLOSED,
    'timed out': _NO_ANSWER,
    'no ports found': 'no device matches; waiting for one',
    'that is not open': GONE,
}


def explain(error: BaseException) -> str:
    """The text for an error of the system or of pyserial."""
    for cause in _system_errors(error):
        if isinstance(cause, socket.gaierror):
            return 'no host of that name is known'
        if cause.args[0] in _HINTS:
            return _HINTS[cause.args[0]]
    return next((meaning for part, meaning in _TEXTS.items() if part in str(error)), str(error))


def _system_errors(error: Optional[BaseException]) -> Iterator[BaseException]:
    """Those among it and the ones before it: pyserial hides them behind its own."""
    while error is not None:
        if isinstance(error, (OSError, termios.error)) and error.args:
            yield error
        error = error.__context__
