"""What is wrong with a port, in words for people."""
import errno
import termios
from typing import Optional


class PortError(Exception):
    """The port cannot be opened, or is gone; the text is for people."""


class PortBusy(Exception):
    """The port takes no bytes now; nothing of this write was sent."""


GONE = 'the device has gone'
_ABSENT = 'there is no such device; waiting for it'
_IN_USE = 'another program has it open; `rosrun serial_communication ports` names it'
_DENIED = 'permission denied; `rosrun serial_communication ports` has the remedy'

# Where the system's own words do not say what to do.
_HINTS = {
    errno.ENOENT: _ABSENT,
    errno.ENXIO: _ABSENT,
    errno.ENODEV: GONE,
    errno.EIO: GONE,
    errno.EACCES: _DENIED,
    errno.EPERM: _DENIED,
    errno.EBUSY: _IN_USE,
    errno.EAGAIN: _IN_USE,
    errno.ENOTTY: 'this is not a serial port',
    errno.ECONNREFUSED: 'connection refused; does the server run, and is its port right?',
    errno.ETIMEDOUT: 'the host does not answer',
}


def explain(error: BaseException) -> str:
    """The text for an error of the system or of pyserial."""
    system: Optional[BaseException] = None
    cause: Optional[BaseException] = error
    while cause is not None:        # pyserial hides the system's error behind its own
        if isinstance(cause, (OSError, termios.error)) and len(cause.args) > 1:
            system = cause
        cause = cause.__context__
    if system:
        return _HINTS.get(system.args[0]) or str(system.args[1]).lower()
    return str(error)
