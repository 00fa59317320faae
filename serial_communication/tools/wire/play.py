"""Sends what a board sent, from a recording, at the recorded intervals.

A recording is a bag of serial_msg (rosbag record /serial_msg), or what wire listen has printed. A
bridge at the other end of the port then receives what the one on the robot did.

Noise, incomplete frames and frames with a wrong checksum are left out. What the bridge sends to the
port is read and dropped. So on the bus no call succeeds: no recorded reply has the random number of
this bridge's ECHO. To try calls, use a simulated board.
"""
import argparse
import re
import time
from typing import List, Tuple

from ...framing.stream import CHECKSUM, FRAMING, OVERSIZE
from ...transport.port import Port, PortBusy, PortError
from . import lines
from .lines import WireError, note

SUMMARY = 'send what a board sent, from a recording, at the recorded intervals'

Recorded = List[Tuple[float, bytes]]     # frames, each with its time in s

_TYPE = 'serial_communication/SerialMsg'
_RX = 0                  # as SerialMsg has it
_PRINTED = re.compile(r'(\d\d):(\d\d):(\d\d\.\d+)(?: +\+[\d.]+ \w+)? +'
                      r'((?:[0-9a-f]{2} )*[0-9a-f]{2})(?:  .*)?\n?')
_DAY = 86400.0           # s
_NOT_WHOLE = (CHECKSUM, FRAMING, OVERSIZE)
_LONGEST_WAIT = 1.0      # s that a read waits, at most: see listen.py


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire play`."""
    parser.add_argument('file', metavar='FILE', help='a bag, or what wire listen has printed')
    lines.add_options(parser, with_port=True)


def run(options: argparse.Namespace) -> int:
    """Play the recording and return the exit status."""
    line = lines.settings(options)
    with open(options.file, 'rb') as file:
        is_bag = file.readline(100).startswith(b'#ROSBAG')
    recorded = from_bag(options.file, line.board.name) if is_bag else printed(options.file)
    frames = whole(recorded, line)
    if not frames:
        raise WireError(f'{options.file}: no frames of the link {line.board.name}')
    port = Port(options.port, line.baud)
    try:
        port.open()
        note(f'{len(frames)} frames; {len(recorded) - len(frames)} invalid ones are left out')
        lost = _play(frames, port)
    except PortError as error:
        raise WireError(f'{options.port}: {error}') from None
    finally:
        port.close()
    if lost:
        raise WireError(f'{options.port} did not take {lost} frames: nothing reads the other end')
    return 0


def from_bag(path: str, link: str) -> Recorded:
    """Return what the board of a link sent, from a bag; WireError if the bag cannot be read."""
    try:
        import rosbag
        with rosbag.Bag(path) as bag:
            topics = [name for name, topic in bag.get_type_and_topic_info().topics.items()
                      if topic.msg_type == _TYPE]
            if len(topics) > 1:
                raise ValueError(f'it has frames of several bridges, {", ".join(topics)}: rosbag '
                                 'filter selects one')
            return [(message.header.stamp.to_sec(), bytes(message.frame))
                    for _, message, _ in bag.read_messages(topics)
                    if message.link == link and message.direction == _RX] if topics else []
    except Exception as error:  # pylint: disable=broad-except
        # rosbag raises anything for a damaged bag; ImportError: ROS is not sourced.
        raise WireError(f'{path}: cannot be read: {error!r}'.splitlines()[0]) from None


def printed(path: str) -> Recorded:
    """Return the frames of the lines that `wire listen` printed."""
    frames: Recorded = []
    with open(path, encoding='utf-8', errors='replace') as file:
        for found in filter(None, map(_PRINTED.fullmatch, file)):
            hours, minutes, seconds, data = found.groups()
            at = int(hours) * 3600 + int(minutes) * 60 + float(seconds)
            while frames and at < frames[-1][0] - _DAY / 2:      # midnight
                at += _DAY
            frames.append((at, bytes.fromhex(data)))
    return frames


def whole(recorded: Recorded, line: lines.Settings) -> Recorded:
    """Return those that are one frame each, valid or of an unknown type."""
    decoder = line.decoder()
    frames = []
    for at, data in recorded:
        found = decoder.feed(data)
        decoder.reset()
        if len(found) == 1 and found[0].raw == data and found[0].cause not in _NOT_WHOLE:
            frames.append((at, data))
    return frames


def _play(frames: Recorded, port: Port) -> int:
    """Send the frames at their intervals; return how many the port did not take."""
    due, before = time.monotonic(), frames[0][0]
    lost = 0
    for at, data in frames:
        due += max(at - before, 0.0)     # of a clock that was set back: at once
        before = at
        wait = due - time.monotonic()
        while wait > 0:
            port.read(min(wait, _LONGEST_WAIT))      # what the bridge sends is dropped
            wait = due - time.monotonic()
        try:
            port.write(data)
        except PortBusy:
            lost += 1
    return lost
