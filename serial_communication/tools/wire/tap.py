"""Sits in the line between a computer and a board: forwards and shows what each sends.

Connect it with two serial adapters, one to the board and one to the computer (TX to RX, RX to
TX, ground to ground), or on the bridge's own computer with two linked ports and no adapter:

  rosrun serial_communication socat_pair /tmp/bridge /tmp/tap &
  wire tap arduino /dev/ttyUSB0 /tmp/tap
  roslaunch serial_communication bridge.launch arduino_port:=/tmp/bridge

Bytes are forwarded unchanged, each direction in a thread that does nothing else, so a blocked
terminal or a slow disk never delays the line. Nothing is kept for later, since a command to a
motor must not arrive seconds late: when an end takes no data, when an end is closed, and when this
program was suspended, the bytes that waited are dropped and reported. Each direction then resumes
with a whole frame. The board is first sent what makes it safe: for the arduino 0x00 and SPEED 0.
An arduino behind a network port that is silent for 1 s is connected again. Either end may vanish
and return.
"""
import argparse

from ...transport.urls import url_argument
from . import display, lines

SUMMARY = 'sit between computer and board, forward and show both directions'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire tap`."""
    lines.add_options(parser)
    for end in 'board', 'computer':
        parser.add_argument(f'{end}_port', metavar=f'{end.upper()}_PORT', type=url_argument,
                            help=f'the port of the {end}')
    display.add_options(parser)


def run(options: argparse.Namespace) -> int:
    """Tap and return the exit status."""
    ports = [options.board_port, options.computer_port]
    if ports[0] == ports[1]:
        raise lines.UsageError('the two ports are the same')
    return display.show_live(lines.settings(options), ports, options)
