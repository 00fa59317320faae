"""Where the page is served: a free port, who has one that is taken, and the address to open."""
import fcntl
import glob
import io
import os
import socket
import struct
from contextlib import suppress
from pathlib import Path
from typing import List, Optional, Tuple

import tornado.netutil

from ..ports.devices import program
from .guard import is_loopback

_LISTENS = '0A'        # state of a socket in /proc/net/tcp
_SIOCGIFADDR = 0x8915  # the request for an interface's address
_NEXT_PORTS = 20       # that are tried after one that is taken


def listen(port: int, bind: str) -> List[socket.socket]:
    """Listen on this TCP port (0: any free one); OSError if it is not available."""
    return tornado.netutil.bind_sockets(port, bind, reuse_port=False)


def listen_near(port: int, bind: str) -> List[socket.socket]:
    """Listen on the first free port from this one; OSError if there is none nearby."""
    for number in range(port, min(port + _NEXT_PORTS, 65535)):
        with suppress(OSError):
            return listen(number, bind)
    return listen(port, bind)


def free_port(port: int, bind: str) -> int:
    """The number of a free port after this one; 0 if there is none nearby."""
    try:
        sockets = listen_near(port + 1, bind)
    except OSError:
        return 0
    number = sockets[0].getsockname()[1]
    for each in sockets:
        each.close()
    return number


def listener(port: int) -> str:
    """Which program listens on a TCP port of this machine: its name and process id.

    Only root sees the processes of other users.
    """
    sockets = set()
    for table in '/proc/net/tcp', '/proc/net/tcp6':
        with suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == _LISTENS and int(fields[1].rpartition(':')[2], 16) == port:
                    sockets.add(f'socket:[{fields[9]}]')
    for path in glob.iglob('/proc/[0-9]*/fd/*'):
        with suppress(OSError):
            if os.readlink(path) in sockets:
                return str(program(int(path.split('/')[2])))
    return 'another program' if sockets else ''


def page_address(bind: str, port: int, token: Optional[str]) -> str:
    """The address to open in a browser.

    The token is in the part after #, which browsers send to no server.
    """
    host = _own_address() if bind in ('0.0.0.0', '::', '') else bind
    host = f'[{host}]' if ':' in host else host
    return f'http://{host}:{port}/' + (f'#{token}' if token else '')


def qr_code(text: str) -> str:
    """The text as a QR code for a terminal, or how to get one."""
    try:
        import qrcode
    except ImportError:
        return 'for a QR code of it: sudo apt-get install python3-qrcode'
    code, out = qrcode.QRCode(border=2), io.StringIO()
    code.add_data(text)
    code.print_ascii(out, invert=True)
    return out.getvalue()


def _own_address() -> str:
    """The address of this machine in its network, which a phone can open; else its name."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(('192.0.2.1', 9))     # sends nothing; 192.0.2.0/24 is for documentation
        return probe.getsockname()[0]
    # No route: perhaps this machine is the access point.
    return next((each for each in map(_address_of, socket.if_nameindex())
                 if not is_loopback(each)), socket.gethostname())


def _address_of(interface: Tuple[int, str]) -> str:
    """The IPv4 address of a network interface; that of loopback if it has none."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        answer = fcntl.ioctl(probe, _SIOCGIFADDR, struct.pack('256s', interface[1].encode()))
        return socket.inet_ntoa(answer[20:24])
    return '127.0.0.1'
