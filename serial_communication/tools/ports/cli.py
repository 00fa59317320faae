"""rosrun serial_communication ports: which board is on which port.

Listens to each port and shows the board whose frames it receives, the port's names, who has it
open, and whether this user may open it; and then the lines to put into a configuration. It writes
not one byte, unless --ask is given, and needs no ROS master. A port that another program has open
is not touched. (An Arduino resets when its port is opened for the first time after it was plugged
in.)
"""
import argparse
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Dict, Iterator, List, NamedTuple, Optional

from ...boards import BoardError, descriptions
from ...boards.config_file import board_packages, board_parameters, read_parameters
from ...output import end_with_output, prepare_output
from ...transport.urls import url_argument
from . import devices
from .devices import Device
from .listening import Candidate, Received, listen

_LONGEST = 120.0     # s to listen
_SAMPLE = 24         # bytes that are shown

_EXAMPLES = """\
examples:
  ports                              every serial port of this computer
  ports --ask                        also find a bus board
  ports /dev/ttyUSB0 socket://192.168.1.7:4001 --json
"""


class Found(NamedTuple):
    """One port, and what was received there."""

    device: Device
    holders: List[str]
    heard: Received


def main(arguments: Optional[List[str]] = None) -> int:
    """Run the program and return the exit status."""
    prepare_output()
    options = _arguments(arguments)
    return end_with_output(lambda: _run(options))


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
    parameters = read_parameters(config) if config else {}
    candidates = [Candidate(board, board_parameters(parameters, board.name))
                  for board in descriptions(board_packages(parameters))]
    for candidate in candidates:     # ValueError for a mistake in a parameter
        candidate.decoder()
        candidate.board.baud_of(candidate.parameters)
    return candidates


def _run(options: argparse.Namespace) -> int:
    there = devices.devices()
    chosen = [next((device._replace(path=url) for device in there
                    if device.path == os.path.realpath(url)), Device(url))
              for url in options.ports] or there
    if not options.json and chosen:
        print('Listening ...', file=sys.stderr)
    with ThreadPoolExecutor(max(1, len(chosen))) as pool:
        ports = list(pool.map(lambda device: _look_at(device, options), chosen))
    if options.json:
        print(json.dumps(list(map(_as_object, ports)), indent=2))
    elif ports:
        print('\n\n'.join(_paragraphs(ports, options)))
    else:
        print('This computer has no serial port. Does the USB cable carry data? `dmesg | tail` '
              'shows what was plugged in.')
    return 0


def _look_at(device: Device, options: argparse.Namespace) -> Found:
    holders = devices.holders_of(device.path)
    # A second reader would take bytes from the program that has a port open.
    return Found(device, holders, Received(trouble='another program has it open') if holders else
                 listen(device.path, options.candidates, options.seconds, options.ask))


def _as_object(port: Found) -> Dict[str, object]:
    device, heard = port.device, port.heard
    return {'port': device.path, 'board': heard.board or None, 'heard': heard.kind,
            'baud': heard.baud, 'held_by': ', '.join(port.holders) or None, 'name': device.name,
            'by_id': device.by_id or None, 'by_path': device.by_path or None,
            'adapter': device.adapter or None, 'trouble': heard.trouble or None}


def _paragraphs(ports: List[Found], options: argparse.Namespace) -> Iterator[str]:
    boards = {each.board.name: each.board for each in options.candidates}
    for device, holders, heard in ports:
        if heard.board:
            board = boards[heard.board]
            words = board.name + f' ({board.title})' * bool(board.title) + (
                f', at {heard.baud} baud' if heard.baud != board.baud else '')
        elif heard.trouble:
            words = f'not listened to: {heard.trouble}'
        elif heard.data:
            words = 'bytes of no known board, at no usual baud rate: ' \
                f'{heard.data[:_SAMPLE].hex(" ")} {ascii(heard.data[:_SAMPLE])[1:]}'
        else:
            words = 'silent'
        shared = ' (the same for every adapter of this kind: it has no serial number)'
        lines = (('by-id', device.by_id and device.by_id + shared * (not device.serial)),
                 ('by-path', device.by_path), ('adapter', device.adapter),
                 ('open in', ', '.join(holders)), ('access', devices.no_access(device.path)))
        yield '\n'.join([f'{device.path}  {words}', *(
            f'    {name:<9}{text}' for name, text in lines if text)])
    found = {port.heard.board: port for port in reversed(ports) if port.heard.board}
    for name, first in found.items():
        if sum(port.heard.board == name for port in ports) > 1:
            yield f'note: {name} is on several ports; the first is taken: {first.device.name}'
    kinds = {port.heard.kind for port in ports if not port.heard.trouble}
    if 'nothing' in kinds and not options.ask:
        yield 'note: a bus board is silent until it is asked: run this again with --ask'
    if 'noise' in kinds and not options.config:
        yield 'note: a board that sends only custom messages is found with their configuration: ' \
            'run this again with --config FILE'
    yield '\n'.join(['Put into a configuration (bridge.launch config:=FILE):', *(
        f'{name}: {{port: {port.device.name}, baud: {port.heard.baud}}}'
        for name, port in sorted(found.items()))]) if found else 'No board was found.'


if __name__ == '__main__':
    sys.exit(main())
