"""URLs of ports, as pyserial has them: their parts, which are valid, and which name the same port.
"""
import argparse
import os
import re
import stat
from typing import Hashable, Optional, Tuple
from urllib.parse import urlsplit

import serial

NETWORK = 'socket', 'rfc2217'       # the schemes with a host
_PTMX = os.makedev(5, 2)            # /dev/ptmx


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
    check_device(port.port)


def url_argument(text: str) -> str:
    """For argparse: a device or URL that pyserial may be able to open."""
    try:
        check_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text}: {error}') from None
    return text


def check_device(path: str) -> None:
    """Raise ValueError for a device that is not a port."""
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


def identity(url: str) -> Optional[Hashable]:
    """A value that is equal for two URLs of the same port; by its path if the device is absent.

    None: each opening leads to a different port (loop://).
    """
    url, scheme = read_url(url)
    if scheme == 'loop' or scheme == 'hwgrep' and 'skip_busy' in url:
        return None
    if scheme in NETWORK:
        host = urlsplit(url)
        return ('127.0.0.1' if host.hostname == 'localhost' else host.hostname), host.port
    path = url
    try:
        path = serial.serial_for_url(url, do_not_open=True).port    # also of hwgrep://, spy://
        found = os.stat(path)
    except OSError:
        return os.path.realpath(path)
    except ValueError:
        return url      # not a port; opening it reports why
    # The device number is the same for links and for other names of the device in a container.
    return found.st_rdev if stat.S_ISCHR(found.st_mode) else os.path.realpath(path)
