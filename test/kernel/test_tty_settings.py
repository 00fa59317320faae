"""Settings of a tty that another program changes during use, and who may open a tty."""
import errno
import fcntl
import os
import struct
import subprocess
import sys
import termios

import pytest
from waiting import all_of

from serial_communication.transport import open_port, tty_settings
from serial_communication.transport.port import Port

EVERY_BYTE = bytes(range(256))
_IS_EXCLUSIVE = 0x80045440      # TIOCGEXCL, which termios does not name
_NOBODY = 65534


def stty(path, *arguments):
    """Run stty as a user does in another terminal."""
    return subprocess.run(['stty', '-F', path, *arguments], check=True, stdout=subprocess.PIPE,
                          universal_newlines=True).stdout


@pytest.mark.parametrize('arguments', [
    ['sane'], ['echo'], ['icanon'], ['icrnl'], ['ixon'], ['istrip'], ['cstopb'], ['crtscts'],
    ['9600'], ['min', '200']], ids=' '.join)
def test_settings_changed_by_another_program_are_told_and_restored(port, line, arguments):
    before = stty(line.path, '-g')
    assert not port.changed_settings()
    stty(line.path, *arguments)
    if stty(line.path, '-g') == before:
        pytest.skip('a pseudo terminal has no such setting')
    assert port.changed_settings()
    port.renew()
    assert stty(line.path, '-g') == before
    assert not port.changed_settings(), 'reported twice'
    line.write(EVERY_BYTE)
    assert all_of(port.read, 256) == EVERY_BYTE
    port.write(EVERY_BYTE)
    assert line.read_all() == EVERY_BYTE, 'changed bytes, or an echo'


def test_a_device_that_does_not_take_its_settings_is_left_alone_after_3_tries(
        port, line, monkeypatch):
    monkeypatch.setattr(tty_settings, 'write', lambda fd, settings: None)
    stty(line.path, 'icanon')
    assert [bool(port.changed_settings()) for _ in range(5) if port.renew() == 0] == [
        True] * 2 + [False] * 3


def test_bytes_that_waited_under_other_settings_are_dropped(port, line):
    stty(line.path, 'sane')
    line.write(b'\r\x08\x15')
    port.renew()
    line.read_all()
    line.write(b'later')
    assert all_of(port.read, 5) == b'later'


# -- who may open it ------------------------------------------------------------------------------

def is_exclusive(fd):
    return struct.unpack('i', fcntl.ioctl(fd, _IS_EXCLUSIVE, bytes(4)))[0]


def open_as_ordinary_user(path):
    """The errno of opening it as a user without privileges; 0: it can be opened."""
    code = ('import os, sys\nif os.geteuid() == 0: os.setgid({0}); os.setuid({0})\n'
            'try: os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)\n'
            'except OSError as error: sys.exit(error.errno)').format(_NOBODY)
    return subprocess.run([sys.executable, '-c', code, path]).returncode


def test_an_open_tty_is_locked_until_it_is_closed(line, port, monkeypatch):
    """A pseudo terminal, which itself is not locked, stands in for a device: both are ttys."""
    device = os.path.realpath(line.path)
    os.chmod(device, 0o666)
    other = os.open(device, os.O_RDWR | os.O_NOCTTY)
    assert not is_exclusive(other)
    port.close()
    monkeypatch.setattr(open_port, '_PTY', ())
    for _ in range(2):
        port.open()
        assert is_exclusive(other)
        assert open_as_ordinary_user(device) == errno.EBUSY
        port.close()
        assert not is_exclusive(other)
        assert open_as_ordinary_user(device) == 0
    os.close(other)


@pytest.mark.parametrize('before', [['sane'], ['parmrk', 'ignpar', 'cstopb'], ['9600', 'ixany']])
def test_an_opened_tty_is_raw_whatever_its_settings_were(line, before):
    stty(line.path, *before)
    port = Port(line.path)
    port.open()
    iflag, oflag, cflag, lflag, speed = termios.tcgetattr(port._opened._fd)[:5]
    assert (iflag, oflag, lflag, speed) == (0, 0, 0, termios.B115200)
    assert cflag & ~termios.B115200 == termios.CS8 | termios.CREAD | termios.CLOCAL
    port.close()
