"""rosrun serial_communication release: run a command while it borrows a port of the bridge.

The bridge stops the car (SPEED 0), closes the port of the LINK, and opens it again when the
command ends or is killed. If this program is killed, so is the command, and the bridge opens the
port after a few seconds. {port} in the COMMAND is the device, and so this has to run on the
machine of the bridge. Exit status: the command's, 128 and the number of the signal that ended it,
127 if it cannot be started, 125 if the port is not lent, 2 for a wrong argument.
"""
import argparse
import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
from typing import Callable, List
from urllib.parse import urlsplit

import rosgraph
import serial

from serial_communication.srv import Release, ReleaseRequest

from ..output import prepare_output
from .watch.calls import MOST_WAIT, Verdict, call, node_argument
from .watch.topics import NODE

_NOT_LENT, _NOT_STARTED = 125, 127
_LOAN, _RENEW = 5.0, 1.0    # s
_TRIES, _AGAIN = 6, 0.2     # for longer than the bridge refuses calls after a stall; s
_PR_SET_PDEATHSIG = 1


def main() -> int:
    """Run the command and return the exit status."""
    prepare_output()
    options = _arguments(sys.argv[1:])
    if not shutil.which(options.command[0]):
        return _say(f'there is no program {options.command[0]}', _NOT_STARTED)
    # The bridge keeps 60 characters of it, and the pid must be among them.
    by = f'{os.path.basename(options.command[0])[:40]} (pid {os.getpid()})'

    def lend(seconds: float) -> str:
        """Borrow the port, or go on; return why it is not lent, or ''."""
        answer = call(f'{options.node}/{options.link}/release', Release,
                      ReleaseRequest(by, seconds), time.monotonic() + 2 * MOST_WAIT)
        return '' if answer.outcome is Verdict.DONE else answer.words

    try:
        device = _device(options.node, options.link)
        why_not = lend(_LOAN)
        for _ in range(_TRIES):
            if why_not:
                time.sleep(_AGAIN)
                why_not = lend(_LOAN)
        if why_not:
            raise ValueError(why_not)
    except (OSError, ValueError, rosgraph.MasterException) as error:
        return _say(str(error), _NOT_LENT)
    try:
        return _run([word.replace('{port}', device) for word in options.command],
                    lambda: lend(_LOAN))
    finally:
        lend(0.0)


def _arguments(arguments: List[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='release', usage='release LINK [--node NAME] -- COMMAND …',
        description=__doc__.partition('\n\n')[2],
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('link', metavar='LINK', help='arduino, mcu, bus, or of another board')
    parser.add_argument('--node', type=node_argument, default=NODE, metavar='NAME',
                        help='name of the bridge (%(default)s)')
    at = arguments.index('--') if '--' in arguments else len(arguments)
    options = parser.parse_args(arguments[:at])
    options.command = arguments[at + 1:]
    if not options.command:
        parser.error('a COMMAND is missing, after --')
    return options


def _say(text: str, status: int) -> int:
    print(f'release: {text}', file=sys.stderr)
    return status


def _device(node: str, link: str) -> str:
    """The device of a link's port, or its URL; ValueError if there is none here, OSError if the
    master does not answer."""
    master = rosgraph.Master('/release')
    try:
        url = master.getParam(f'{node}/{link}/port')
        host = urlsplit(master.lookupNode(node)).hostname or ''
    except rosgraph.MasterException:
        raise ValueError(f'there is no bridge {node} with a port of {link}') from None
    if not url:
        raise ValueError(f'the link {link} is off: it has no port')
    device = serial.serial_for_url(url, do_not_open=True).port or url
    if '://' not in device and not rosgraph.network.is_local_address(host):
        raise ValueError(f'{device} is a device of {host}, where the bridge runs: run this there')
    return device


def _run(command: List[str], renew: Callable[[], object]) -> int:
    """Run a command that ends with this process and gets its signals; return the exit status."""
    prctl = ctypes.CDLL(None).prctl
    try:
        process = subprocess.Popen(
            command, preexec_fn=lambda: prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0))
    except OSError as error:
        return _say(f'{command[0]} cannot be started: {error.strerror}', _NOT_STARTED)

    def pass_on(number: int, _frame: object) -> None:
        if number != signal.SIGINT or not os.isatty(0):     # a terminal sends it to both
            process.send_signal(number)

    for number in signal.SIGINT, signal.SIGTERM, signal.SIGHUP:
        if signal.getsignal(number) != signal.SIG_IGN:      # nohup, or a background job
            signal.signal(number, pass_on)
    while True:
        try:
            status = process.wait(_RENEW)
            return status if status >= 0 else 128 - status
        except subprocess.TimeoutExpired:
            renew()
