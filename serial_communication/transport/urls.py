"""URLs of ports, as pyserial has them: their parts, which are valid, and which name the same port.
"""
import os
import re
from contextlib import suppress
from typing import Hashable, Optional, Tuple
from urllib.parse import urlsplit

import serial

NETWORK = 'socket', 'rfc2217'       # the schemes with a host


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
        with suppress(ValueError, KeyError, OSError):    # pyserial's texts for this are unusable
            if urlsplit(url).hostname and urlsplit(url).port:
                port.from_url(url)
                return
        raise ValueError(f'{scheme}:// takes a host, a port and options of pyserial, as in '
                         f'{scheme}://192.168.1.5:4001')


def identity(url: str) -> Optional[Hashable]:
    """A value that is equal for two URLs of the same port; None: each opening leads to another."""
    url, scheme = read_url(url)
    if scheme == 'loop' or scheme == 'hwgrep' and 'skip_busy' in url:
        return None
    if scheme in NETWORK:
        host = urlsplit(url)
        return ('127.0.0.1' if host.hostname == 'localhost' else host.hostname), host.port
    try:
        return os.path.realpath(serial.serial_for_url(url, do_not_open=True).port)
    except OSError:
        return os.path.realpath(url)
    except ValueError:
        return url      # not a port; opening it reports why
