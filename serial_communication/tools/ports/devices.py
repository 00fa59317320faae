"""The serial ports of this computer: their names, who has them open, and who may open them."""
import glob
import grp
import os
from contextlib import suppress
from typing import Dict, List, NamedTuple, Set, Tuple

from serial.tools import list_ports

from ...transport.port import open_in

_TTYS = '/sys/class/tty'
_LINKS = '/dev/serial'      # udev's names, in by-id and by-path


class Device(NamedTuple):
    """One serial port of this computer."""

    path: str
    by_id: str = ''        # the name by the adapter's serial number; '': it has none
    by_path: str = ''      # the name by the socket that it is plugged into
    adapter: str = ''      # what the USB adapter says it is; '': it is no USB adapter
    serial: str = ''       # its serial number

    @property
    def name(self) -> str:
        """The name that stays the same: by-id needs a serial number, by-path the same socket."""
        return (self.by_id if self.serial else self.by_path) or self.by_path or self.path


def devices() -> List[Device]:
    """All serial ports, sorted; without those of the kernel's list that have no hardware."""
    usb, by_id, by_path = _usb_adapters(), _links('by-id'), _links('by-path')
    return [Device(path, by_id.get(path, ''), by_path.get(path, ''), *usb.get(path, ()))
            for path in _paths()]


def _paths() -> List[str]:
    names = [os.path.basename(path) for path in glob.glob(f'{_TTYS}/*')]
    found = [f'/dev/{name}' for name in names
             if os.path.exists(f'{_TTYS}/{name}/device')
             and _content(f'{_TTYS}/{name}/type') != '0\n']     # 0: an 8250 without hardware
    return sorted(filter(os.path.exists, found), key=lambda path: (
        path.rstrip('0123456789'), len(path), path))


def _content(path: str) -> str:
    with suppress(OSError), open(path, encoding='utf-8', errors='replace') as file:
        return file.read()
    return ''


def _usb_adapters() -> Dict[str, Tuple[str, str]]:
    """The last two fields of a `Device`, by its path."""
    with suppress(OSError, TypeError, ValueError):     # an adapter that vanished meanwhile
        return {each.device: (
            f'{each.manufacturer or ""} {each.product or ""} {each.vid:04x}:{each.pid:04x}'.strip(),
            each.serial_number or '') for each in list_ports.comports() if each.vid is not None}
    return {}


def _links(kind: str) -> Dict[str, str]:
    """udev's names of one kind, by the path of the device."""
    return {os.path.realpath(link): link for link in sorted(glob.glob(f'{_LINKS}/{kind}/*'))}


def holders_of(path: str) -> List[str]:
    """The programs that have a device open, or hold its lock, as far as this user may see them."""
    with suppress(OSError):
        pids = open_in(path) | _by_lock(os.stat(path))
        return list(map(program, sorted(pids)))
    return []


def _by_lock(port: os.stat_result) -> Set[int]:
    """Those that hold its lock; seen for the processes of all users."""
    inode = f'{os.major(port.st_dev):02x}:{os.minor(port.st_dev):02x}:{port.st_ino}'
    with suppress(IndexError, ValueError):
        return {int(words[4]) for words in map(str.split, _content('/proc/locks').splitlines())
                if words[1] == 'FLOCK' and words[5] == inode and int(words[4]) > 0}
    return set()


def program(pid: int) -> str:
    """A process, by the name of its script, not of the interpreter; '?' if it has just ended."""
    words = list(filter(None, _content(f'/proc/{pid}/cmdline').split('\0')))
    names = [os.path.basename(word) for word in words] or ['?']
    is_script = names[0].startswith('python') and len(words) > 1 and words[1][0] != '-'
    return f'{names[is_script]} (pid {pid})'


def no_access(path: str) -> str:
    """What helps a user who may not open a device; '' if this user may."""
    if not os.path.exists(path) or os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return ''
    status = os.stat(path)
    with suppress(KeyError):     # a group without a name
        group = grp.getgrgid(status.st_gid).gr_name
        if status.st_mode & 0o060 == 0o060 and group != 'root':
            return 'this user may not open it; join the group that owns it: ' \
                f'sudo usermod -a -G {group} $USER, and log in again'
    return 'this user may not open it: a udev rule can give it to a group, as in ' \
        'config/99-serial_communication.rules'
