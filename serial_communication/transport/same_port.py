"""Which port a URL leads to, whatever it is called there."""
import os
import stat
from typing import Any
from urllib.parse import urlsplit

import serial

from .port import NETWORK, read_url


def identity(url: str) -> Any:
    """Equal for two URLs that lead to one port; None where each opening has a port of its own.

    A device that is not there now is known by its path alone.
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
        path = serial.serial_for_url(url, do_not_open=True).port    # of spy:// and alt:// as well
        found = os.stat(path)
    except OSError:
        return os.path.realpath(path)
    except ValueError:
        return url      # nothing that can be opened
    # By its number: links, and a second name of the same device in a container.
    return found.st_rdev if stat.S_ISCHR(found.st_mode) else os.path.realpath(path)
