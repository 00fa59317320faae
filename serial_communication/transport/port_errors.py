"""What is wrong with a port, in words for people, and what to do about it if that is known."""
import errno
import grp
import os
import pwd
import socket
import termios
from typing import Callable, Iterator, Optional

from . import devices
from .holders import holders_of

WAITING = '; waiting for it'     # in the text for a device that is absent, for who does not wait


class PortError(Exception):
    """The port cannot be opened, or is gone; the text is for people."""


class PortBusy(Exception):
    """The port takes no bytes now; nothing of this write was sent."""


GONE = 'the device has gone'
_ABSENT = 'there is no such device; waiting for it'
_IN_USE = 'another program has it open'
_CLOSED = 'the other side closed the connection'
_NO_ANSWER = 'the host does not answer'
_NO_RFC2217 = 'the other side does not speak RFC 2217; socket:// is for a plain TCP connection'
_NO_PORT = 'this is not a serial port'

_HINTS = {
    errno.ENOENT: _ABSENT,
    errno.ENXIO: _ABSENT,
    errno.ENODEV: GONE,
    errno.EIO: GONE,
    errno.EPERM: 'permission denied',
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


def who_has_it_open(path: str) -> str:
    """Which programs have a device open, for people; this reads the open files of all of them."""
    holders = holders_of(path)
    if [holder.pid for holder in holders] == [os.getpid()]:
        return f'this program itself has it open (pid {os.getpid()})'
    if not holders:
        return f'{_IN_USE}, of another user: `sudo fuser -v {path}` names it'
    return f'{_IN_USE}: {", ".join(map(str, holders))}'


def explain(error: BaseException, path: str = '',
            in_use: Callable[[str], str] = who_has_it_open) -> str:
    """The text for an error of the system or of pyserial. `path`: of the device, if it is one;
    `in_use`: says who has it open."""
    for cause in _system_errors(error):
        if isinstance(cause, socket.gaierror):
            return 'no host of that name is known'
        number = cause.args[0]
        if path and number in (errno.EBUSY, errno.EAGAIN):
            return in_use(path)
        if path and number == errno.ENOENT:
            return _ABSENT + _what_is_there(path)
        hint = _who_may_open(path) if number == errno.EACCES else _HINTS.get(number)
        if hint:
            return hint
    return next((meaning for part, meaning in _TEXTS.items() if part in str(error)), str(error))


def _system_errors(error: Optional[BaseException]) -> Iterator[BaseException]:
    """Those among it and the ones before it: pyserial hides them behind its own."""
    while error is not None:
        if isinstance(error, (OSError, termios.error)) and error.args:
            yield error
        error = error.__context__


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
    return f"; this computer has {', '.join(devices.paths()) or 'no serial port'}"
