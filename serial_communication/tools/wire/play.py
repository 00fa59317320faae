"""Sends what a board sent, damage and all, out of a recording at the recorded times.

A recording is a bag of serial_msg (rosbag record /serial_msg) or what wire listen --raw and wire
tap --raw wrote. A bridge on the other end of the port then sees what the one on the robot saw:

  rosrun serial_communication socat_pair /tmp/bridge /tmp/board &
  roslaunch serial_communication bridge.launch mcu_port:=/tmp/bridge &
  wire play drive.bag mcu /tmp/board

What the bridge says to the port is read and dropped: the board that plays does not listen. For
the arduino and the mcu that changes nothing. On the bus it does: a board that plays back answers
what the recorded bridge asked, when that one asked it. The bridge on the desk sees all these
frames in serial_msg and counts the same damage, but takes none of them for an answer to a request
of its own (its ECHO carries a number that no recording can know), so its calls end with TIMEOUT,
its diagnostics say that the board does not answer, and nothing is published from the bus. To try
calls, use a simulated board: rosrun serial_communication simulator bus.

Times are kept with real-time priority where the system allows it. With a --rate other than 1 the
bridge sees silences of another length than the board's.
"""
import argparse
import json
import sys
import threading
import time
from typing import Any, Dict, List, Sequence

from ...transport.pace import set_priority
from ...transport.port import Port, PortBusy, PortError
from . import lines
from .figures import percentile
from .playback import Piece, differences, is_whole, pieces_of, spaced
from .recording import frames_of, load
from .show import Trouble, complain, is_terminal, seconds

SUMMARY = 'what a board sent, out of a recording, onto a port at the recorded times'

_REALTIME_PRIORITY = 15
_PROGRESS = 0.2           # s from one progress line to the next on a terminal …
_PROGRESS_PLAIN = 10.0    # … and elsewhere
_PAUSE = 2.0              # of frame_timeout, from the end to the start with --loop
_MOVED = 1e-6             # s from its time at which a piece counts as moved


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the command line may say."""
    parser.add_argument('recording', metavar='RECORDING', help='a bag, or a file of --raw')
    lines.add_options(parser)
    parser.add_argument('port', metavar='PORT', type=lines.port,
                        help='a device, or whatever pyserial opens')
    parser.add_argument('--topic', default='', help='of the bag, where several have frames')
    parser.add_argument('--from', dest='begin', type=clock, default=0.0, metavar='TIME',
                        help='from the start of the recording: s, or m:s')
    parser.add_argument('--to', dest='end', type=clock, default=float('inf'), metavar='TIME',
                        help='likewise')
    parser.add_argument('--rate', type=lines.positive, default=1.0, metavar='FACTOR',
                        help='2 is twice as fast (%(default)g)')
    parser.add_argument('--loop', action='store_true', help='again and again, until Ctrl-C')
    parser.add_argument('--json', action='store_true',
                        help='at the end an object: frames, bad, left_out, moved, rounds, lost, '
                             'late (s)')


def clock(text: str) -> float:
    """Seconds of `12.5` or `1:12.5`.

    Raises:
        argparse.ArgumentTypeError: it is neither.
    """
    minutes, _, rest = text.rpartition(':')
    try:
        value = int(minutes or 0) * 60 + float(rest)
    except ValueError:
        value = -1.0
    if not 0 <= value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is no time such as 12.5 or 1:12.5')
    return value


class Player:
    """Writes pieces at their times, in a thread that does nothing else, and drops what comes.

    Args:
        port: open.
        pause: s from the end to the start again; None: once only.
    """

    def __init__(self, port: Port, pieces: Sequence[Piece], pause: float = -1.0) -> None:
        self.played = 0                  # pieces
        self.rounds = 0                  # ended
        self.lost = 0                    # bytes that the port did not take
        self.trouble = ''                # why it ended early
        self.errors: List[float] = []    # of the latest round: s by which each was late
        self.ended = threading.Event()
        self._port = port
        self._pieces = pieces
        self._pause = pause
        self._stopping = threading.Event()
        self._threads = [threading.Thread(target=run, name=name, daemon=True) for name, run in (
            ('playing', self._play), ('draining', self._drain))]

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End; the port may be closed when this returns."""
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
        errors = self.errors = []
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
            errors.append(time.monotonic() - due)
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
    """Play; the exit status."""
    line = lines.settings(options)
    recording = load(options.recording, options.topic)
    frames = [each.frame for each in frames_of(recording, line) if not each.sent]
    original = [piece for piece in pieces_of(recording, frames, line)
                if options.begin <= piece.at < options.end]
    if not original:
        raise Trouble(f'{options.recording}: nothing of a board on the link {line.link} in this '
                      f'time; links in it: {", ".join(recording.links()) or "none"}')
    pieces = spaced(original, line, options.rate)
    shifts = [abs(piece.at - before.at / options.rate) for piece, before in zip(pieces, original)]
    frames = [frame for frame in frames if options.begin <= frame.stamp < options.end]
    told = {'frames': len(frames), 'bad': sum(bool(frame.cause) for frame in frames),
            'left_out': sum(not is_whole(frame, line) for frame in frames),
            'moved': sum(shift > _MOVED for shift in shifts)}
    _announce(told, pieces, max(shifts), differences(frames, pieces, line))
    port = Port(options.port, line.baud)
    try:
        port.open()
    except PortError as error:
        raise Trouble(f'{options.port}: {error}') from None
    player = Player(port, pieces, line.frame_timeout * _PAUSE if options.loop else -1.0)
    stopped = False
    try:
        player.start()
        _follow(player, pieces)
    except KeyboardInterrupt:
        stopped = True
    player.stop()
    port.close()
    return _result(player, told, options, stopped)


def _announce(told: Dict[str, Any], pieces: Sequence[Piece], longest_shift: float,
              different: int) -> None:
    complain(f'{told["frames"]} frames, {told["bad"]} of them bad, in '
             f'{pieces[-1].at - pieces[0].at:.1f} s')
    if told['moved']:
        complain(f'{told["moved"]} incomplete frames are sent up to {seconds(longest_shift)} from '
                 'when they came, so that they are given up just as they were')
    if told['left_out']:
        complain(f'{told["left_out"]} bad frames are left out: the bag has a part of each only')
    if different:
        complain(f'{different} frames will not come out as they were; are frame_timeout and '
                 'options those of the recorded bridge?')


def _follow(player: Player, pieces: Sequence[Piece]) -> None:
    """Show how far it is: a line that is rewritten on a terminal, now and then one elsewhere."""
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
            text += f', {player.lost} bytes lost: the port does not take them'
        sys.stderr.write(begin + text + end + '\n' * (rewrites and ended))
        sys.stderr.flush()


def _result(player: Player, told: Dict[str, Any], options: argparse.Namespace,
            stopped: bool) -> int:
    late = {name: percentile(player.errors, percent) for name, percent in (
        ('p50', 50), ('p99', 99), ('max', 100))} if player.errors else None
    if options.json:
        print(json.dumps(dict(told, rounds=player.rounds, lost=player.lost, late=late)))
    elif late:
        complain(f'late by {seconds(late["p50"])} at the median, {seconds(late["p99"])} at p99, '
                 f'{seconds(late["max"])} at most')
    if player.trouble:
        complain(f'{options.port}: {player.trouble}')
    elif player.lost:
        complain(f'{options.port} did not take {player.lost} bytes: nobody reads the other end, '
                 'or the port is slower than this')
    elif stopped:
        complain('stopped')
        return 0 if options.loop else 130
    return 1 if player.trouble or player.lost else 0
