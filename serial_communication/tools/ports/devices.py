"""The serial ports of this computer, with all their names."""
import glob
import os
from typing import Dict, List, NamedTuple, Tuple

from serial.tools import list_ports

_TTYS = '/sys/class/tty'
_LINKS = '/dev/serial'      # udev's names, in by-id and by-path


class Device(NamedTuple):
    """One serial port of this computer."""

    path: str
    by_id: str = ''        # the name by the adapter's serial number; '': it has none
    by_path: str = ''      # the name by the socket that it is plugged into
    adapter: str = ''      # what the USB adapter says it is; '': it is no USB adapter
    usb_id: str = ''       # its vendor and product, as 0403:6001
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
             and first_line(f'{_TTYS}/{name}/type') != '0']     # 0: an 8250 without hardware
    return sorted(filter(os.path.exists, found), key=_order)


def first_line(path: str) -> str:
    """The first line of a file of the kernel's; '' if it cannot be read."""
    try:
        with open(path, encoding='utf-8', errors='replace') as file:
            return file.readline().strip()
    except OSError:
        return ''


def _order(path: str) -> Tuple[str, int]:
    name = path.rstrip('0123456789')
    return name, int(path[len(name):] or 0)


def _usb_adapters() -> Dict[str, Tuple[str, str, str]]:
    """The last three fields of a `Device`, by its path."""
    try:
        return {each.device: (
            ' '.join(filter(None, (each.manufacturer, each.product))) or 'USB adapter',
            f'{each.vid:04x}:{each.pid:04x}', each.serial_number or '')
            for each in list_ports.comports() if each.vid is not None}
    except (OSError, TypeError, ValueError):
        return {}     # an adapter that vanished meanwhile


def _links(kind: str) -> Dict[str, str]:
    """udev's names of one kind, by the path of the device."""
    return {os.path.realpath(link): link for link in sorted(glob.glob(f'{_LINKS}/{kind}/*'))}
