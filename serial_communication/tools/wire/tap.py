"""Sits in the line between a computer and a board: passes on what each says, and shows it.

Wire it in with two serial adapters, one to the board and one to the computer (TX to RX, RX to
TX, ground to ground); or on the bridge's own computer with two linked ports and no adapter:

  rosrun serial_communication socat_pair /tmp/bridge /tmp/tap &
  wire tap arduino /dev/ttyUSB0 /tmp/tap
  roslaunch serial_communication bridge.launch arduino_port:=/tmp/bridge

Bytes pass unchanged, in both directions at once, in threads that do nothing else: a terminal that
stands still, or a slow disk, never holds up the line. Nothing is kept for later, since a command
to a motor must not arrive seconds late: where an end takes no data, where an end is closed, and
where this program was suspended, what waited is dropped, and reported. After that, each direction
goes on with a whole frame, and before it with what makes the board safe: for the arduino a 0x00 and
SPEED 0. An arduino behind a network port that is silent for 1 s is connected anew. Either end may
go and come back.
"""
import argparse

from . import lines, onlooker

SUMMARY = 'sits between computer and board, passes both directions on and shows both'


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the command line may say."""
    lines.add_options(parser)
    for end in 'board', 'computer':
        parser.add_argument(f'{end}_port', metavar=f'{end.upper()}_PORT', type=lines.port,
                            help=f'where the {end} is')
    onlooker.add_options(parser)


def run(options: argparse.Namespace) -> int:
    """Tap; the exit status."""
    ports = [options.board_port, options.computer_port]
    if ports[0] == ports[1]:
        raise lines.Unusable('the two ports are the same')
    return onlooker.look_on(lines.settings(options), ports, options)
