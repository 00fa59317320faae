"""What one board's protocol decides: the base of all sessions, which a link drives.

Pure: no port, no thread. Bytes have become frames, time is an argument, and packets come out, which
the link writes at once. `now` is in seconds of a clock that also runs while the computer is
suspended.
"""
import threading
import traceback
from collections import Counter
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

from ..framing.stream import Decoder, Frame
from .announcement import BoardAnnouncement
from .line import Line
from .outcome import Refused  # noqa: F401  for the boards
from .presence import Presence
from .settings import BoardSettings
from .sparing_log import SparingLog

OK, WARN, ERROR = 0, 1, 2      # as in diagnostic_msgs/DiagnosticStatus
RX, TX = 0, 1                  # as in SerialMsg


class Packet(NamedTuple):
    """What is to be written: the bytes, and what `Frame` has of them."""

    frame: bytes
    type: int
    number: int         # CMD2 of a request, SEQ, else 0
    data: bytes
    message: Any


class Condition(NamedTuple):
    """The state of a link or a board."""

    level: int
    name: str           # one word that does not change, for programs
    summary: str        # for people


class Doubt(Exception):
    """What waits, or what the board does, is not known any more: the link begins anew. The text
    says why."""


class Session:
    """The base of all sessions. A subclass overrides what its board needs.

    The link calls `received`, `damaged` and `talks` in its thread without the lock. It calls all
    else with the lock held; so do subclasses where they share something with those.

    Args:
        network_silence: s without a byte after which a port that hides what it has not sent is in
            doubt; 0: never.
    """

    NAME = ''
    # True: it tells old replies from new ones by itself. What waited during a stall is decoded.
    FENCED = False
    board_settings: Optional[BoardSettings] = None      # None: the board has none
    reads = True            # the board reads now what is sent to it
    line: Line              # what was written; set by the link
    BEATS = False           # True: `beat` is called by a thread of its own
    # Sent after a packet that may have been cut off: it ends the part that the board has received.
    ENDS_FRAME = b''

    def __init__(self, decoder: Decoder, log: SparingLog, network_silence: float = 0.0) -> None:
        self.decoder = decoder
        self.log = log
        # By cause, those of the decoder also while there are none.
        self.errors: Dict[str, int] = Counter(dict.fromkeys(decoder.CAUSES, 0))
        self.timeouts = 0           # requests without an answer
        self.frames_received = 0    # valid ones
        self.frames_sent = 0
        self.stale = 0              # bytes dropped because they may be old
        # Called with the link's name, RX or TX, and every frame; None: nobody listens.
        self.tap: Optional[Callable[[str, int, Frame], None]] = None
        self.lock = threading.RLock()
        self.is_stopped = False     # by ~stop: whatever moves is refused
        self.presence = Presence(log)
        self.announcement = BoardAnnouncement(log)
        self.wake: Callable[[], None] = lambda: None    # set by the link: have `due` called soon
        self.network_silence = network_silence

    # -- what happens -------------------------------------------------------------------

    def begin(self, now: float, is_opening: bool) -> None:
        """Begin anew: the port was opened, or it stays open and what waited in it was dropped."""

    def received(self, frame: Frame, now: float) -> None:
        """A valid frame was received."""

    def damaged(self, frame: Frame, now: float) -> None:
        """An invalid frame or noise was received; it is already counted and logged."""

    def sent(self, packet: Packet, now: float) -> None:
        """A packet was written."""

    def not_sent(self, packet: Packet, why: str) -> None:
        """A packet could not be written."""

    def end(self, why: str, now: float) -> None:
        """The port was closed."""

    # -- what to do -----------------------------------------------------------------------

    def due(self, now: float, is_drained: bool) -> Tuple[Sequence[Packet], Optional[float]]:
        """What is to be sent now, and when to call again at the latest, or None.

        Called then, after `wake`, when no bytes are received, and every 0.1 s at the latest. Doubt:
        the link begins anew.

        Args:
            is_drained: whether all bytes that had been received are decoded.
        """
        return (), None

    def idle(self, now: float) -> Optional[float]:
        """Do what is due while the port is closed; return when to call again, or None."""
        return None

    def beat(self, now: float) -> Tuple[Sequence[Packet], float]:
        """What is to be sent now by the heartbeat's thread, and when to call again."""
        raise NotImplementedError

    def submit(self, request: Any, now: float) -> Sequence[Packet]:
        """Take a request; return what is to be sent at once. Refused: it may not be sent now."""
        raise NotImplementedError

    def may_be_old(self, request: Any) -> bool:
        """Whether a request is taken although it may have waited during a stall."""
        return False

    def stop(self, now: float, why: str = '') -> Tuple[Sequence[Packet], str]:
        """What stops all that moves, and what cannot be stopped, or ''.

        Args:
            why: the port is given up for this reason: nothing may follow.
        """
        return (), ''

    def under_way(self, is_reset: bool = False) -> str:
        """What the board does and must not be interrupted, by a reset or a loan, for people; '':
        nothing."""
        return ''

    def was_reset(self) -> None:
        """The bridge has reset the board."""

    def tapped(self, direction: int, frame: Frame) -> None:
        """Pass a frame to who listens."""
        tap = self.tap      # another thread may set it to None meanwhile
        try:
            if tap:
                tap(self.NAME, direction, frame)
        except Exception:  # pylint: disable=broad-except
            # Guarded: an error here would look as if the frame had not been sent.
            self.log.error('fault', traceback.format_exc())

    # -- what it looks like -----------------------------------------------------------------

    def condition(self, now: float) -> Condition:
        """The board's state while the port is open."""
        if self.talks(now):
            return Condition(OK, 'ok', 'open')
        return Condition(WARN, 'silent',
                         f'open, {self.presence.no_frame(now) or "the board is silent"}')

    def talks(self, now: float) -> Optional[bool]:
        """Whether the board talks, None: unknown; changes are logged."""
        return self.presence.talks(now)

    def shown(self, frame: Frame) -> Frame:
        """What `tap` gets for a received frame; called before `received`."""
        return frame

    def values(self) -> List[Tuple[str, Any]]:
        """Further keys and values for /diagnostics."""
        return []
