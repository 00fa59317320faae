"""The program: one simulated board on one serial port, until it is stopped."""
import argparse
import importlib
import re
import signal
import sys
import time
from random import SystemRandom
from typing import Any, List, NoReturn, Optional, Type

from ..boards import BOARDS, BoardError, description
from ..boards.description import Description
from ..output import no_more_output, prepare_output
from ..transport.pace import Allowance
from ..transport.port import Port
from . import faults
from .arguments import url_argument
from .board import Board, Runner
from .custom_messages import add_options, announced_text
from .own_pty import OwnPty

_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_BURST, _RATE = 20, 2.0      # printed lines: in a burst, and per second after that
_LONGEST = 150               # characters of a line

_EXAMPLES = """\
examples (each with  rosrun serial_communication  before it, or in a checkout with  scripts/):
  simulator bus --link /tmp/bus                 /tmp/bus is the bridge's port
  simulator bus --link /tmp/bus --faults 'delay=0.05:0.6-1 reset=1/min'
  simulator arduino --link /tmp/car --calibration-time 60
  simulator mcu --link /tmp/mcu --adc --rate 50
  simulator arduino --link /tmp/car --faults all --seed 7
  simulator my_package --link /tmp/mine         a board of another package: see CONTRIBUTING.md

On a port that is there already, here one end of a pair of linked ports:
  socat pty,raw,echo=0,link=/tmp/ttyV0 pty,raw,echo=0,link=/tmp/ttyV1 &
  simulator bus --port /tmp/ttyV1

It waits for a port that is absent, and opens it again if it vanishes. Ctrl-C ends it.
"""


def main(arguments: Optional[List[str]] = None) -> int:
    """Run the program; return its exit status."""
    prepare_output()
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    say = _Printer(options.board)
    try:
        port = Port(options.port, options.baud) if options.port else OwnPty(options.link)
    except OSError as error:
        print(f'link {options.link}: {error.strerror}', file=sys.stderr)
        return 1
    board_faults = faults.Faults(options.rates, options.seed)
    runner = Runner(options.board_class.from_options(options), port, say, board_faults)
    for number in _STOPS:
        signal.signal(number, lambda *_: runner.stop())
    if options.rates:
        say(f'seed {options.seed}, faults {options.faults}')
    try:
        runner.run()
    finally:
        if isinstance(port, OwnPty):
            port.remove()
    if options.rates:
        counts = ', '.join(f'{name} {count}' for name, count in board_faults.counts.items())
        say(f'{runner.line.frames} frames; faults: {counts or "none"}')
    return 0


class _Printer:
    """Prints lines at a readable rate; ignores a closed standard output."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._allowance = Allowance(_BURST, _RATE)
        self._left_out = 0

    def __call__(self, text: str) -> None:
        if not self._allowance.take(time.monotonic()):
            self._left_out += 1
            return
        if len(text) > _LONGEST:
            text = text[:_LONGEST] + ' …'
        if self._left_out:
            text += f' ({self._left_out} lines left out before this)'
            self._left_out = 0
        try:
            print(f'{self._name}: {text}', flush=True)
        except OSError:
            no_more_output()


# -- the command line -------------------------------------------------------------------------


class _Parser(argparse.ArgumentParser):
    """Reports a wrong argument in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        print(f'{self.prog}: {message}. Try: {self.prog} --help', file=sys.stderr, flush=True)
        if any(each.startswith('__log:=') for each in sys.argv):
            # Started by roslaunch, which would start it again and again with the same arguments.
            signal.pause()
        sys.exit(2)


def _parse(arguments: List[str]) -> argparse.Namespace:
    # Without those that roslaunch adds: __name:=… and remappings.
    arguments = [each for each in arguments if not re.match(r'[\w/~]+:=', each)]
    parser = _Parser(
        prog='simulator', epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='A simulated board on a serial port, for trying a bridge without hardware.')
    boards = parser.add_subparsers(dest='board', metavar='BOARD', required=True)
    of_another_package = [name for name in arguments[:1] if re.fullmatch(r'\w+(\.\w+)*', name)
                          and name not in BOARDS]
    for name in (*BOARDS, *of_another_package):
        try:
            _add(boards, name, description(name))
        except BoardError as error:
            parser.error(f'there is no board {name}, only {", ".join(BOARDS)}, and it is not a '
                         f'package with a board: {error}')
    options = parser.parse_args(arguments)
    try:
        options.announcement = announced_text(options.board, options.config) \
            if getattr(options, 'announce', False) else None
        options.rates = faults.parse(options.faults, options.board_class)
    except ValueError as error:
        parser.error(str(error))
    if options.baud is None:
        options.baud = options.config.baud
    if options.seed is None:
        options.seed = SystemRandom().randrange(1 << 31)
    return options


def _add(boards: Any, name: str, described: Description) -> None:
    module = importlib.import_module(described.package + '.simulator')
    board: Type[Board] = module.BOARD
    parser = boards.add_parser(
        name, help=board.SUMMARY, formatter_class=argparse.RawDescriptionHelpFormatter,
        description=module.__doc__, epilog=_fault_help(board))
    parser.set_defaults(board_class=board)
    port = parser.add_mutually_exclusive_group()
    port.add_argument('--link', default='', metavar='PATH',
                      help='a link to the pseudo terminal that it makes, for the bridge')
    port.add_argument('--port', type=_port,
                      help='use this device or URL that pyserial opens, and make none')
    parser.add_argument('--baud', type=int, help=f'(that of --config, or {described.baud})')
    parser.add_argument('--faults', default='', metavar="'KIND=RATE[:S] …'",
                        help='see below; those that this board cannot have are left out')
    parser.add_argument('--seed', type=int, metavar='N',
                        help='of faults and noise; the same seed repeats a run')
    board.add_options(parser)
    add_options(parser, described)


def _fault_help(board: Type[Board]) -> str:
    lines = ['faults: KIND=RATE[:SECONDS], as flip=0.01 (one frame in a hundred) or '
             'silence=2/min:0.5-2']
    for name, kind in faults.KINDS.items():
        if faults.fits(name, board):
            lasts = ' ({:g}-{:g} s)'.format(*kind.seconds) if any(kind.seconds) else ''
            lines.append(f'  {name:10} {kind.text}{lasts}')
    return '\n'.join((*lines, f'  {"all":10} {board.FAULTS}'))


def _port(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError('is empty')
    return url_argument(text)
