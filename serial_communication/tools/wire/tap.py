"""Sits in the line between a computer and a board: passes on what each says, and shows it.

Wire it in with two serial adapters, one to the board and one to the computer (TX to RX, RX to
TX, ground to ground); or on the bridge's own computer with two linked ports and no adapter:

  rosrun serial_communication socat_pair /tmp/bridge /tmp/tap &
  wire tap arduino /dev/ttyUSB0 /tmp/tap
  roslaunch serial_communication bridge.launch arduino_port:=/tmp/bridge

Bytes pass unchanged, in both directions at once, in threads that do nothing else: a terminal that
stands still, or a slow disk, never holds up the line. Nothing is kept for later, since a command
to a motor must not arrive seconds late: where an end takes no data, where an end is closed, and
where this program was suspended, what waited is dropped, and told. After that, each direction
goes on with a whole frame; on the link arduino with a 0x00 and, to the board, SPEED 0 before it. A
board of that link behind a network port that is silent for 1 s is connected anew. Either end may
go and come back.

--measure needs no ports: it tells what a tap adds on this machine, with heartbeats through two
pseudo terminals and, in turns, through one without a tap.
"""
import argparse
import sys

from ...transport.port import Port
from . import lines, measure, onlooker
from .onlooker import End

SUMMARY = 'sits between computer and board, passes both directions on and shows both'


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the command line may say."""
    lines.add_options(parser)
    parser.add_argument('board_port', metavar='BOARD_PORT', nargs='?', type=onlooker.port_name,
                        help='where the board is')
    parser.add_argument('computer_port', metavar='COMPUTER_PORT', nargs='?',
                        type=onlooker.port_name, help='where the computer is')
    onlooker.add_options(parser)
    parser.add_argument('--measure', action='store_true',
                        help='instead: what a tap adds, in ms, over --duration seconds (10)')


def run(options: argparse.Namespace) -> int:
    """Tap; the exit status."""
    if options.measure:
        return measure.run(options.link, options.duration or 10.0, options.json)
    if options.computer_port is None:
        print('wire tap: two ports are needed: the board\'s and the computer\'s', file=sys.stderr)
        return 2
    if options.board_port == options.computer_port:
        print('wire tap: the two ports are the same', file=sys.stderr)
        return 2
    line = lines.settings(options)
    board, computer = (Port(url, line.baud)
                       for url in (options.board_port, options.computer_port))
    return onlooker.look_on(line, [End(board, False), End(computer, True)], options)
