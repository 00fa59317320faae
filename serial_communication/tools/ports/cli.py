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
from typing import Any, Dict, Iterator, List, Optional

from ...boards import BoardError, descriptions
from ...output import end_with_output, prepare_output
from ...simulation.arguments import board_packages, read_parameters, url_argument
from ..wire.lines import Settings, settings_of
from . import devices
from .devices import Device
from .listening import Received, listen

_LONGEST = 120.0     # s to listen
_SAMPLE = 24         # bytes that are shown
_NONE = 'This computer has no serial port. Does the USB cable carry data? `dmesg | tail` shows ' \
    'what was plugged in.'


def main(arguments: Optional[List[str]] = None) -> int:
    """Run the program and return the exit status."""
    prepare_output()
    options = _arguments(arguments)
    return end_with_output(lambda: _run(options))


def _arguments(arguments: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='ports', description=__doc__.partition('\n\n')[2],
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
        options.boards = _boards(options.config)
    except (OSError, BoardError, ValueError) as error:
        parser.error(f'{options.config}: {getattr(error, "strerror", None) or error}')
    return options


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 < value <= _LONGEST:
        raise argparse.ArgumentTypeError(f'{text} s is out of range (above 0, at most '
                                         f'{_LONGEST:g})')
    return value


def _boards(config: str) -> List[Settings]:
    """The boards that may be on a port, as a configuration has them; ValueError for a mistake."""
    parameters = read_parameters(config) if config else {}
    return [settings_of(board, parameters) for board in descriptions(board_packages(parameters))]


def _run(options: argparse.Namespace) -> int:
    there = devices.devices()
    chosen = [next((device._replace(path=url) for device in there
                    if device.path == os.path.realpath(url)), Device(url))
              for url in options.ports] or there
    if not options.json and chosen:
        print('Listening ...', file=sys.stderr)
    with ThreadPoolExecutor(max(1, len(chosen))) as pool:
        ports = list(pool.map(lambda device: _look_at(device, options), chosen))
    print(json.dumps(ports, indent=2) if options.json else
          '\n\n'.join(_paragraphs(ports, options)) if ports else _NONE)
    return 0


def _look_at(device: Device, options: argparse.Namespace) -> Dict[str, Any]:
    """What is printed of a port."""
    holders = devices.holders_of(device.path)
    # A second reader would take bytes from the program that has a port open.
    heard = Received(trouble='another program has it open') if holders else listen(
        device.path, options.boards, options.seconds, options.ask)
    words = heard.data[:_SAMPLE]
    return {'port': device.path, 'board': heard.board or None, 'baud': heard.baud,
            'heard': 'frames' if heard.board else 'noise' if heard.data else 'nothing',
            'held_by': ', '.join(holders) or None, 'name': device.name,
            'by_id': device.by_id or None, 'by_path': device.by_path or None,
            'adapter': device.adapter or None, 'trouble': heard.trouble or None,
            'access': devices.no_access(device.path) or None,
            'bytes': f'{words.hex(" ")} {ascii(words)[1:]}' if words else None}


def _paragraphs(ports: List[Dict[str, Any]], options: argparse.Namespace) -> Iterator[str]:
    titles = {each.board.name: each.board.title or 'no title' for each in options.boards}
    found: Dict[str, Dict[str, Any]] = {}
    for port in ports:
        board = port['board']
        if board:
            words = f'{board} ({titles[board]}), at {port["baud"]} baud'
        elif port['trouble']:
            words = f'not listened to: {port["trouble"]}'
        else:
            words = 'bytes of no known board, at no usual baud rate' if port['bytes'] else 'silent'
        keys = ('by_id', 'by_path', 'adapter', 'held_by', 'access', 'bytes')[:6 - bool(board)]
        yield '\n'.join([f'{port["port"]}  {words}', *(
            f'    {key:<9}{port[key]}' for key in keys if port[key])])
        if board and found.setdefault(board, port) is not port:
            yield f'note: {board} is on several ports; the first is taken: {found[board]["name"]}'
    kinds = {port['heard'] for port in ports if not port['trouble']}
    if 'nothing' in kinds and not options.ask:
        yield 'note: a bus board is silent until it is asked: run this again with --ask'
    if 'noise' in kinds and not options.config:
        yield 'note: a board that sends only custom messages is found with their configuration: ' \
            'run this again with --config FILE'
    yield '\n'.join(['Put into a configuration (bridge.launch config:=FILE):', *(
        f'{name}: {{port: {port["name"]}, baud: {port["baud"]}}}'
        for name, port in sorted(found.items()))]) if found else 'No board was found.'
