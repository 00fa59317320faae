"""Why a user may not open a port, what makes it slow, or lets another program steal its bytes; each
with its remedy."""
import glob
import grp
import os
import pwd
from typing import List

from .devices import first_line

_LATENCY = '/sys/bus/usb-serial/devices/{}/latency_timer'
_PROCESSES = '/proc/[0-9]*/comm'
_GRABBERS = {
    'ModemManager': 'it sends bytes to new serial ports, to find modems: '
                    'sudo systemctl disable --now ModemManager (or the rules in config/)',
    'brltty': 'it takes USB adapters for Braille displays: sudo apt-get remove brltty',
}


def of_port(path: str) -> List[str]:
    """Remedies for one device."""
    return _of_access(path) + _of_latency(path)


def _of_access(path: str) -> List[str]:
    try:
        status = os.stat(path)
        group, owner = grp.getgrgid(status.st_gid).gr_name, pwd.getpwuid(status.st_uid).pw_name
    except (OSError, KeyError):     # no device, or a user or group without a name
        return []
    if os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return []
    if status.st_mode & 0o060 == 0o060 and group != 'root':
        return [f'this user may not open it; join the group that owns it: sudo usermod -a -G '
                f'{group} $USER, and log in again']
    return [f'only {owner} may open it: a udev rule can give it to a group, as in '
            'config/99-serial_communication.rules']


def _of_latency(path: str) -> List[str]:
    timer = _LATENCY.format(os.path.basename(os.path.realpath(path)))
    milliseconds = first_line(timer)
    if milliseconds.isdigit() and int(milliseconds) > 1:
        return [f'the adapter holds bytes back for {milliseconds} ms, unless the program that '
                f'opens the port may change that: echo 1 | sudo tee {timer}']
    return []


def of_computer() -> List[str]:
    """Remedies for all ports of this computer."""
    running = {first_line(path) for path in glob.glob(_PROCESSES)}
    return [f'{name} is running; {what}' for name, what in _GRABBERS.items() if name in running]
