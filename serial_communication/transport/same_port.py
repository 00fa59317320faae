"""Finds out whether two URLs name the same port."""
import os
import stat
from typing import Hashable, Optional
from urllib.parse import urlsplit

import serial

from .port import NETWORK, read_url


def identity(url: str) -> Optional[Hashable]:
    """A value that is equal for two URLs of the same port.

    None: each opening leads to a different port (loop://). A device that is absent is identified
    by its path.
    """
    url, scheme = read_url(url)
    rest = url.partition('://')[2]
    if scheme == 'loop' or scheme == 'hwgrep' and 'skip_busy' in rest:
        return None
    if scheme in NETWORK:
        host = urlsplit(url)
        return ('127.0.0.1' if host.hostname == 'localhost' else host.hostname), host.port
    if scheme == 'hwgrep':
        return rest
    path = url
    try:
        path = serial.serial_for_url(url, do_not_open=True).port    # also of spy:// and alt://
        found = os.stat(path)
    except OSError:
        return os.path.realpath(path)
    except ValueError:
        return url      # not a port; opening it reports why
    # The device number is the same for links and for other names of the device in a container.
    return found.st_rdev if stat.S_ISCHR(found.st_mode) else os.path.realpath(path)
