"""The lines that are known here, and one direction of one, decoded as a link decodes it."""
import argparse
import sys
from typing import Any, List, NamedTuple, Optional, Tuple

from ...boards import BOARDS
from ...protocols import arduino, mcu, own_messages
from ...protocols import robot_ctrl_bus as bus
from ...protocols.frame_timer import FrameTimer
from ...protocols.framing import Frame
from ...simulation.own_messages import read

BAUD = 115200
MAX_BAUD = 10 ** 8
FRAME_TIMEOUT = 0.05     # s; the default of the bridge's parameter frame_timeout
UNKNOWN_TYPE = 'not known here'      # what `explain` says of one
_TYPES = ('type', 'TYPE', 'CMD1', 'CMD2')    # fields that say what a frame is


class Settings(NamedTuple):
    """What has to be known of a line to decode it, as the bridge's parameters have it."""

    link: str
    baud: int = BAUD
    frame_timeout: float = FRAME_TIMEOUT     # s
    reply_has_cmd2: bool = False
    own: Tuple[Any, ...] = ()                # messages or functions of one's own


def positive(text: str) -> float:
    """For argparse: a number above 0."""
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value


def baud(text: str) -> int:
    """For argparse, and of a recording: a baud rate."""
    value = int(text)
    if not 0 < value <= MAX_BAUD:
        raise argparse.ArgumentTypeError(f'{text} is none of 1 to {MAX_BAUD}')
    return value


def add_link_options(parser: argparse.ArgumentParser) -> None:
    """LINK, and what changes how its bytes are read."""
    parser.add_argument('link', metavar='LINK', choices=BOARDS,
                        help='whose protocol it is: ' + ', '.join(BOARDS))
    parser.add_argument('--reply-has-cmd2', action='store_true',
                        help="bus: replies carry their request's CMD2")
    add_config_option(parser)
    parser.set_defaults(baud=BAUD, frame_timeout=FRAME_TIMEOUT)


def add_config_option(parser: argparse.ArgumentParser) -> None:
    """What `own` reads."""
    parser.add_argument('--config', default='', metavar='FILE',
                        help="parameters of the bridge: its messages and functions of one's own "
                             'are known, too')


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that `settings` reads, LINK among them."""
    add_link_options(parser)
    parser.add_argument('--baud', type=baud, default=BAUD, metavar='N', help='(%(default)d)')
    parser.add_argument('--frame-timeout', type=positive, default=FRAME_TIMEOUT, metavar='S',
                        help='an incomplete frame is given up after so long without a byte, as '
                             "by the bridge's parameter of that name (%(default)g)")


def settings(options: argparse.Namespace) -> Settings:
    """From the command line; a configuration that cannot be used ends the program."""
    return Settings(options.link, options.baud, options.frame_timeout, options.reply_has_cmd2,
                    own(options.config, options.link))


_OWN = {'bus': ('functions', own_messages.bus_functions),
        'arduino': ('messages', own_messages.arduino_messages),
        'mcu': ('messages', own_messages.mcu_messages)}


def own(config: str, link: str) -> Tuple[Any, ...]:
    """What a file of the bridge's parameters has of one's own; nothing where there is no file."""
    if not config or link not in _OWN:
        return ()
    rows, parse = _OWN[link]
    try:
        return tuple(read(config, link, rows, parse))
    except (OSError, ValueError) as error:
        print(f'wire: {config}: {error}', file=sys.stderr)
        raise SystemExit(2) from None


def decoder(line: Settings, sent: bool) -> Any:
    """A decoder of what the board sends, or of what is `sent` to it."""
    if line.link == 'bus':
        return (bus.RequestDecoder(functions=line.own) if sent
                else bus.ReplyDecoder(line.reply_has_cmd2, functions=line.own))
    if line.link == 'arduino':
        kinds = [each.kind for each in line.own if each.is_command == sent]
        return (arduino.BoardDecoder if sent else arduino.Decoder)(messages=kinds)
    # Nobody talks to that board: whatever is sent shows as what it is.
    return mcu.Decoder([each.kind for each in line.own])


def type_name(line: Settings, sent: bool, frame: Frame) -> str:
    """What a good frame is, in the protocol's words."""
    if line.link not in BOARDS:      # of another package
        return f'type 0x{frame.type:02x}'
    parts = decoder(line, sent).explain(frame.raw)
    words = [part.meaning for part in parts if part.name in _TYPES and part.meaning
             and part.meaning != UNKNOWN_TYPE]
    if not words:
        return f'type 0x{frame.type:02x}'
    return words[-1] if words != ['function'] else f'function 0x{frame.command:02x}'


class Direction:
    """What one end of a line says, decoded; live, or later from what was kept.

    Incomplete frames are given up after the same times as in a link, by the times of the reads.
    All times are seconds of one clock. A frame's stamp is the time of the read that brought its
    last byte.
    """

    def __init__(self, line: Settings, sent: bool) -> None:
        self.sent = sent
        self.decoder = decoder(line, sent)
        self._timer = FrameTimer(self.decoder, line.frame_timeout, line.baud)
        self._last_byte = float('-inf')
        self._now = 0.0

    def hear(self, data: bytes, at: float) -> List[Frame]:
        """The frames that are complete, or given up, by the time of this read."""
        frames = []
        while True:
            due = self.due()
            if due is None or due >= at:     # a link looks at its bytes first
                break
            frames += self._give_up(due)
        self._timer.bytes_came(self._last_byte, at)
        self._last_byte = self._now = at
        return frames + self.decoder.feed(data, at) + self._give_up(at)

    def silent_until(self, now: float) -> List[Frame]:
        """The frames that are given up by `now`, if nothing has come."""
        frames: List[Frame] = []
        while True:
            due = self.due()
            if due is None or due > now:
                return frames
            frames += self._give_up(due)

    def due(self) -> Optional[float]:
        """When to call `silent_until` next; None: not before something is heard."""
        return self._timer.due(self._last_byte, self._now)

    def reset(self) -> None:
        """Forget what is pending: the port was closed, or bytes are missing."""
        self.decoder.reset()
        self._timer.reset()

    def _give_up(self, now: float) -> List[Frame]:
        self._now = now
        return self._timer.overdue(self._last_byte, now)
