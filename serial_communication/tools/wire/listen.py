"""Shows every frame that a board sends. Nothing is ever written to the port.

Each line has the time, the time since the frame before, the bytes, and their meaning or what is
wrong with them. The port is opened as the bridge opens it: exclusively, and so that opening it
again does not reset a board (an Arduino resets once, at the first opening after it was plugged
in). Two readers of a port would take bytes from each other, so while the bridge has the port, this
program reports that and ends. An absent port is waited for. Ctrl-C ends the program.

A recording (a file of --raw, or a bag of serial_msg) may be given in place of a port.

examples:
  wire listen mcu /dev/ttyUSB0
  wire listen arduino /dev/serial/by-id/usb-1a86_USB2.0-Serial-if00-port0 --raw drive.txt
  wire listen bus socket://192.168.1.7:4001 --json
  wire listen arduino drive.txt
"""
import argparse
import os

from ...transport.urls import url_argument
from . import display, lines
from .recording import frames_of, learned_from, load

SUMMARY = 'show every frame that a board sends; writes nothing to the port'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire listen`."""
    lines.add_options(parser)
    parser.add_argument('port', metavar='PORT', type=url_argument,
                        help='a device, or whatever pyserial opens; or a recording')
    parser.add_argument('--topic', default='', help='the topic of a bag with several')
    display.add_options(parser)


def run(options: argparse.Namespace) -> int:
    """Listen and return the exit status."""
    line = lines.settings(options)
    if os.path.isfile(options.port):
        recording = load(options.port, options.topic)
        line = learned_from(recording, line)
        return display.show_recorded(frames_of(recording, line), recording.began, options)
    return display.show_live(line, [options.port], options)
