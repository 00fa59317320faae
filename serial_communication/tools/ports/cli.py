"""rosrun serial_communication ports: which board is on which port.

Listens to each port and shows the board whose frames it receives, the port's names, who has it
open, whether this user may open it, and what makes it slow; and then the lines to put into a
configuration. It writes not one byte, unless --ask is given, and needs no ROS master. A port that
another program has open is not touched. (An Arduino resets when its port is opened for the first
time after it was plugged in.)
"""
import argparse
import os
import threading
from typing import Any, Dict, List, Optional

from ...boards import BoardError, descriptions
from ...simulation.arguments import (board_packages, board_parameters, read_parameters,
                                     url_argument)
from ...output import no_more_output, prepare_output
from . import devices
from .devices import Device
from .holders import holders_of
from .listening import Candidate, Received, Listener
from .report import Found, as_json, as_text

_LONGEST = 120.0     # s to listen

_EXAMPLES = """\
examples:
  ports                              every serial port of this computer
  ports --ask                        also find a bus board
  ports /dev/ttyUSB0 socket://192.168.1.7:4001 --json
"""


def main(arguments: Optional[List[str]] = None) -> int:
    """Run the program and return the exit status."""
    prepare_output()
    options = _arguments(arguments)
    try:
        return _run(options)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        no_more_output()
        return 0


def _arguments(arguments: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='ports', description=__doc__.partition('\n\n')[2], epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('ports', metavar='PORT', nargs='*', type=url_argument,
                        help='a device, or whatever pyserial opens (all serial ports of this '
                             'computer)')
    parser.add_argument('--seconds', type=_seconds, default=2.0, metavar='S',
                        help='how long to listen (%(default)g)')
    parser.add_argument('--ask', action='store_true',
                        help='send SYNC to silent ports, to find a bus board, which speaks only '
                             'when it is asked')
    parser.add_argument('--json', action='store_true', help='print a list of objects')
    parser.add_argument('--config', default='', metavar='FILE',
                        help="the bridge's parameters, for custom messages and for boards of "
                             'other packages')
    options = parser.parse_args(arguments)
    try:
        options.candidates = _candidates(options.config)
    except (OSError, BoardError, ValueError) as error:
        parser.error(f'{options.config}: {getattr(error, "strerror", None) or error}')
    return options


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 < value <= _LONGEST:
        raise argparse.ArgumentTypeError(f'{text} s is out of range (above 0, at most '
                                         f'{_LONGEST:g})')
    return value


def _candidates(config: str) -> List[Candidate]:
    parameters: Dict[str, Any] = read_parameters(config) if config else {}
    candidates = [Candidate(board, board_parameters(parameters, board.name))
                  for board in descriptions(board_packages(parameters))]
    for candidate in candidates:     # ValueError for a mistake in a parameter
        candidate.decoder()
        candidate.board.baud_of(candidate.parameters)
    return candidates


def _run(options: argparse.Namespace) -> int:
    chosen = _chosen(options.ports)
    if not chosen:
        print('[]' if options.json else 'This computer has no serial port. Does the USB cable '
              'carry data? `dmesg | tail` shows what was plugged in.')
    ports = _listened(chosen, Listener(options.candidates, options.seconds, options.ask))
    boards = {candidate.board.name: candidate for candidate in options.candidates}
    if ports:
        print(as_json(ports) if options.json else
              as_text(ports, boards, options.seconds, options.ask, options.config))
    return 0


def _chosen(urls: List[str]) -> List[Device]:
    there = devices.devices()
    if not urls:
        return there
    return [next((device._replace(path=url) for device in there
                  if device.path == os.path.realpath(url)), Device(url)) for url in urls]


def _listened(chosen: List[Device], listener: Listener) -> List[Found]:
    """Listen to all ports at the same time."""
    heard: Dict[int, Received] = {}
    found = [Found(device, holders_of(device.path), Received()) for device in chosen]

    def listen(index: int, url: str) -> None:
        heard[index] = listener.listen(url)

    # A second reader would take bytes from the program that has a port open.
    threads = [threading.Thread(target=listen, args=(index, port.device.path), daemon=True,
                                name=port.device.path)
               for index, port in enumerate(found) if not port.holders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    in_use = Received(trouble='another program has it open')
    return [port._replace(heard=heard.get(index, in_use)) for index, port in enumerate(found)]
