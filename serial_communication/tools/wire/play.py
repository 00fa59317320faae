"""Sends what a board sent, from a recording, at the recorded times.

A recording is a bag of serial_msg (rosbag record /serial_msg) or a file of wire listen --raw or
wire tap --raw. A bridge at the other end of the port then receives what the one on the robot did:

  rosrun serial_communication socat_pair /tmp/bridge /tmp/board &
  roslaunch serial_communication bridge.launch mcu_port:=/tmp/bridge &
  wire play drive.bag mcu /tmp/board

A file of --raw has the board's bytes, which are sent as they were, errors included. A bag has
frames. Of these the whole ones are sent; noise, incomplete frames and frames with a wrong checksum
are left out.

What the bridge sends to the port is read and dropped. For the arduino and the mcu that changes
nothing. On the bus the recorded replies answer the requests of the recorded bridge. The new bridge
shows these frames in serial_msg, but accepts none as a reply to its own requests, since its ECHO
has a random number that no recording contains. So its calls end with TIMEOUT, its diagnostics
report that the board does not answer, and nothing from the bus is published. To try calls, use a
simulated board: rosrun serial_communication simulator bus.

The program keeps the times with real-time priority, where the system allows it.
"""
import argparse
import json
import sys
import threading
import time
from typing import Dict, List, NamedTuple, Sequence, Tuple

from ...framing.stream import CHECKSUM, FRAMING, OVERSIZE
from ...transport.pace import set_priority
from ...transport.port import Port, PortBusy, PortError
from ...transport.urls import url_argument
from . import lines
from .figures import percentile
from .recording import Recording, frames_of, load
from .show import WireError, is_terminal, print_note, seconds

SUMMARY = 'send what a board sent, from a recording, at the recorded times'

_REALTIME_PRIORITY = 15
_PROGRESS = 0.2           # s between two progress lines on a terminal …
_PROGRESS_PLAIN = 10.0    # … and elsewhere
_PAUSE = 2.0              # in frame_timeouts, between two rounds of --loop
# Causes of frames of which a bag has only a part, or whose bytes may belong to other frames.
_NOT_WHOLE = (CHECKSUM, FRAMING, OVERSIZE)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire play`."""
    parser.add_argument('recording', metavar='RECORDING', help='a bag, or a file of --raw')
    lines.add_options(parser)
    parser.add_argument('port', metavar='PORT', type=url_argument,
                        help='a device, or whatever pyserial opens')
    parser.add_argument('--topic', default='', help='the topic of a bag with several')
    parser.add_argument('--from', dest='begin', type=clock, default=0.0, metavar='TIME',
                        help='start at this time since the start of the recording: s, or m:s')
    parser.add_argument('--to', dest='end', type=clock, default=float('inf'), metavar='TIME',
                        help='end before this time, likewise')
    parser.add_argument('--rate', type=lines.positive, default=1.0, metavar='FACTOR',
                        help='2 is twice as fast (%(default)g)')
    parser.add_argument('--loop', action='store_true', help='repeat until Ctrl-C')
    parser.add_argument('--json', action='store_true',
                        help='print a JSON object at the end: writes, left_out, rounds, lost, '
                             'late (s)')


def clock(text: str) -> float:
    """Convert `12.5` or `1:12.5` to seconds.

    Raises:
        argparse.ArgumentTypeError: the text is neither.
    """
    minutes, _, rest = text.rpartition(':')
    try:
        value = int(minutes or 0) * 60 + float(rest)
    except ValueError:
        value = -1.0
    if not 0 <= value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not a time such as 12.5 or 1:12.5')
    return value


class Piece(NamedTuple):
    """Bytes to send in one write."""

    at: float           # s since the recording's start
    data: bytes


def pieces_of(recording: Recording, line: lines.Settings) -> Tuple[List[Piece], int]:
    """Return what the board sent, and how many of its frames are left out."""
    reads = recording.reads.get(line.link)
    if reads:
        return [Piece(read.at, read.data) for read in reads if not read.sent], 0
    frames = [each.frame for each in frames_of(recording, line) if not each.sent]
    whole = [frame for frame in frames if frame.cause not in _NOT_WHOLE]
    return [Piece(frame.stamp, frame.raw) for frame in whole], len(frames) - len(whole)


class PiecePlayer:
    """Writes pieces at their times, in its own thread, and drops what the port receives.

    Args:
        port: is open.
        pieces: at least one.
        pause: s between the end of a round and the next round; negative: one round only.
    """

    def __init__(self, port: Port, pieces: Sequence[Piece], pause: float = -1.0) -> None:
        self.played = 0                  # pieces, in all rounds
        self.rounds = 0                  # complete ones
        self.lost = 0                    # bytes that the port did not take
        self.trouble = ''                # why playing ended early
        self.delays: List[float] = []    # s by which each piece of the latest round was late
        self.ended = threading.Event()
        self._port = port
        self._pieces = pieces
        self._pause = pause
        self._stopping = threading.Event()
        self._threads = [threading.Thread(target=run, name=name, daemon=True) for name, run in (
            ('playing', self._play), ('draining', self._drain))]

    def start(self) -> None:
        """Start playing."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End playing. The port may be closed after this returns."""
        self._stopping.set()
        self._port.wake()
        for thread in self._threads:
            thread.join(1.0)

    def _play(self) -> None:
        set_priority(_REALTIME_PRIORITY)
        start = time.monotonic() - self._pieces[0].at
        try:
            while not self._stopping.is_set():
                self._round(start)
                self.rounds += 1
                if self._pause < 0:
                    break
                start += self._pieces[-1].at + self._pause - self._pieces[0].at
        except PortError as error:
            self.trouble = str(error)
        self.ended.set()

    def _round(self, start: float) -> None:
        delays = self.delays = []
        for piece in self._pieces:
            due = start + piece.at
            while True:
                now = time.monotonic()
                if now >= due or self._stopping.wait(due - now):
                    break
            if self._stopping.is_set():
                return
            try:
                self._port.write(piece.data)
            except PortBusy:
                self.lost += len(piece.data)
            delays.append(time.monotonic() - due)
            self.played += 1

    def _drain(self) -> None:
        try:
            while not self._stopping.is_set():
                self._port.read(None)
        except PortError as error:
            self.trouble = self.trouble or str(error)
            self._stopping.set()
            self.ended.set()


def run(options: argparse.Namespace) -> int:
    """Play the recording and return the exit status."""
    line = lines.settings(options)
    recording = load(options.recording, options.topic)
    pieces, left_out = pieces_of(recording, line)
    pieces = [Piece(piece.at / options.rate, piece.data) for piece in pieces
              if options.begin <= piece.at < options.end]
    if not pieces:
        raise WireError(f'{options.recording}: no bytes from the board of the link {line.link} in '
                        'this time; links in it: '
                        f'{", ".join(recording.links()) or "none"}')
    counts = {'writes': len(pieces), 'left_out': left_out}
    print_note(f'{len(pieces)} writes in {pieces[-1].at - pieces[0].at:.1f} s')
    if left_out:
        print_note(f'{left_out} invalid frames of the bag are left out')
    port = Port(options.port, line.baud)
    try:
        port.open()
    except PortError as error:
        raise WireError(f'{options.port}: {error}') from None
    player = PiecePlayer(port, pieces, line.frame_timeout * _PAUSE if options.loop else -1.0)
    stopped = False
    try:
        player.start()
        _show_progress(player, pieces)
    except KeyboardInterrupt:
        stopped = True
    player.stop()
    port.close()
    return _result(player, counts, options, stopped)


def _show_progress(player: PiecePlayer, pieces: Sequence[Piece]) -> None:
    """Show progress until the end: a line that is rewritten on a terminal, else every 10 s."""
    rewrites = is_terminal(sys.stderr)
    begin, end = ('\r', '\033[K') if rewrites else ('', '\n')
    length = pieces[-1].at - pieces[0].at
    ended = False
    while not ended:
        ended = player.ended.wait(_PROGRESS if rewrites else _PROGRESS_PLAIN)
        at = pieces[max(player.played - 1, 0) % len(pieces)].at
        text = f'{at - pieces[0].at:.1f} of {length:.1f} s'
        if player.rounds and not ended:
            text += f', round {player.rounds + 1}'
        if player.lost:
            text += f', {player.lost} bytes lost: the port takes no data'
        sys.stderr.write(begin + text + end + '\n' * (rewrites and ended))
        sys.stderr.flush()


def _result(player: PiecePlayer, counts: Dict[str, int], options: argparse.Namespace,
            stopped: bool) -> int:
    late = {name: percentile(player.delays, percent) for name, percent in (
        ('p50', 50), ('p99', 99), ('max', 100))} if player.delays else None
    if options.json:
        print(json.dumps(dict(counts, rounds=player.rounds, lost=player.lost, late=late)))
    elif late:
        print_note(f'late by {seconds(late["p50"])} at the median, {seconds(late["p99"])} at p99, '
                   f'{seconds(late["max"])} at most')
    if player.trouble:
        print_note(f'{options.port}: {player.trouble}')
    elif player.lost:
        print_note(f'{options.port} did not take {player.lost} bytes: nothing reads the other end, '
                   'or the port is slower than the recording')
    elif stopped:
        print_note('stopped')
        return 0 if options.loop else 130
    return 1 if player.trouble or player.lost else 0
