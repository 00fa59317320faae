"""Every frame that a board sends, as it comes. Nothing is ever written to the port.

A line a frame: the time, how long after the one before, the bytes, and what they say or what is
wrong with them. The port is opened like the bridge opens it: exclusively, and so that opening it
again does not reset a board (an Arduino resets once, at the first opening after it was plugged
in). So while the bridge has the port, this program says so and ends: two readers of a port would
take bytes from each other. A port that is not there yet is waited for, and Ctrl-C ends it.

In the place of a port, a recording (a file of --raw, or a bag of serial_msg) shows what is in it.

examples:
  wire listen mcu /dev/ttyUSB0
  wire listen arduino /dev/serial/by-id/usb-1a86_USB2.0-Serial-if00-port0 --raw drive.txt
  wire listen bus socket://192.168.1.7:4001 --json
  wire listen arduino drive.txt
"""
import argparse
import os

from . import lines, onlooker
from .recording import frames_of, load

SUMMARY = 'every frame that a board sends, as it comes; writes nothing to the port'


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the command line may say."""
    lines.add_options(parser)
    parser.add_argument('port', metavar='PORT', type=lines.port,
                        help='a device, or whatever pyserial opens; or a recording')
    parser.add_argument('--topic', default='', help='of a bag, where several have frames')
    onlooker.add_options(parser)


def run(options: argparse.Namespace) -> int:
    """Listen; the exit status."""
    line = lines.settings(options)
    if os.path.isfile(options.port):
        recording = load(options.port, options.topic)
        return onlooker.show(frames_of(recording, line), recording.began, options)
    return onlooker.look_on(line, [options.port], options)
