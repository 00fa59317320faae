"""Reads and sets the settings of a tty, as Linux keeps them.

One ioctl has all of them, any baud rate included, which the termios module cannot express.
"""
import fcntl
import struct
import termios

_GET, _SET = 0x802C542A, 0x402C542B      # TCGETS2, TCSETS2 of x86, ARM and RISC-V
_FORM = struct.Struct('=4IB19s2I')       # struct termios2: flags, line, characters, two speeds
_OTHER_BAUD = 0o010000                   # BOTHER: a rate without a constant of its own


def read(fd: int) -> bytes:
    """The settings of an open tty; OSError if `fd` is not a tty."""
    return fcntl.ioctl(fd, _GET, bytes(_FORM.size))


def write(fd: int, settings: bytes) -> None:
    """Apply settings from `read` at once; OSError if `fd` is not a tty."""
    fcntl.ioctl(fd, _SET, settings)


def set_raw(fd: int, baud: int) -> bytes:
    """Make the tty raw, 8N1, without flow control; return its settings as `read` does.

    HUPCL is off: closing leaves DTR as it is, so opening it again does not reset a board by DTR.
    """
    termios.tcflow(fd, termios.TCOON)     # another program may have stopped the output
    line, characters = _FORM.unpack(read(fd))[4:6]
    characters = bytearray(characters)
    characters[termios.VMIN] = characters[termios.VTIME] = 0
    rate = getattr(termios, f'B{baud}', _OTHER_BAUD)
    write(fd, _FORM.pack(0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL | rate, 0, line,
                         bytes(characters), baud, baud))
    return read(fd)
