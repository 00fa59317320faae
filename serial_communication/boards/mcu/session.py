"""What the sensor board's frames mean: counts lost ones and reports when the board falls silent."""
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple, Type

from ...framing.announcement import Chunk
from ...framing.layout import LayoutMessage
from ...framing.stream import CHECKSUM, IMPLAUSIBLE, LENGTH, SETTING, UNKNOWN, Frame
from ...link.session import Packet, Session
from ...link.settings import BoardSettings
from ...link.sparing_log import SparingLog
from ...transport.pace import clock
from . import wire

_STATUS_PERIOD = 1.0   # s between two reports of silence


class _Latest(NamedTuple):
    """The latest message of one class."""

    seq: int
    received_at: float
    silent_at: float     # when its absence is reported next


class SensorSession(Session):
    """The session of one sensor board, to which settings alone are sent.

    Args:
        timeout: s without a valid frame after which the board counts as silent.
        on_status: called with the (message, seq, stamp) of each valid frame.
        on_silence: called once a second with (class, seq, age) for each class of built-in message
            that the board has sent and no longer sends: the last seq, and the seconds since that
            message. The class is None until the board has sent one, and the age counts from the
            start, or from the latest custom message.
        now: the clock: the watchdog runs from the start, also without a port.
    """

    NAME = 'mcu'
    board_settings: BoardSettings

    def __init__(self, log: SparingLog, timeout: float = 1.0,
                 on_status: Callable[[Any, int, Any], None] = lambda message, seq, stamp: None,
                 on_silence: Callable[[Optional[Type[LayoutMessage]], int, float], None] =
                 lambda kind, seq, age: None,
                 network_silence: float = 5.0, now: Callable[[], float] = clock) -> None:
        decoder = wire.Decoder()
        super().__init__(decoder, log, network_silence)
        self.board_settings = BoardSettings(log, decoder, lambda: self.wake())
        self.checksum_errors = 0        # those before the frame that is delivered
        self._lost = 0                  # frames
        self._heard_at = float('-inf')  # a message of any class
        self._timeout = timeout
        self._on_status, self._on_silence = on_status, on_silence
        self._last: Optional[Frame] = None      # since the link began anew
        self._seq = 0                           # of the next frame to the board
        # Of built-in messages; by None until the board has sent one.
        self._latest: Dict[Optional[Type[LayoutMessage]], _Latest] = {
            None: _Latest(0, now(), now() + timeout)}

    def begin(self, now: float, is_opening: bool) -> None:
        if is_opening:
            self._last = None
        self.board_settings.reset()

    def end(self, why: str, now: float) -> None:
        self.board_settings.reset()

    def received(self, frame: Frame, now: float) -> None:
        message = frame.message
        self._follow_seq(frame)
        if isinstance(message, Chunk):
            self.announcement.add(message)
        elif frame.type == SETTING:
            self.board_settings.received(message, self.announcement.is_current)
        elif not isinstance(message, wire.Time):
            self._heard_at = now
            kind = type(message) if frame.type in wire.MESSAGES else None
            if kind:
                self._latest.pop(None, None)
            if kind or None in self._latest:      # custom messages have no status of their own
                self._latest[kind] = _Latest(frame.number, now, now + self._timeout)
            if not self.announcement.holds_back(message):
                self._on_status(message, frame.number, frame.stamp)

    def damaged(self, frame: Frame, now: float) -> None:
        # A status reports the errors before its own frame.
        self.checksum_errors += frame.cause == CHECKSUM
        if frame.cause in (LENGTH, IMPLAUSIBLE, UNKNOWN):     # its CRC matches, so its SEQ counts
            self._follow_seq(frame)

    def _follow_seq(self, frame: Frame) -> None:
        """Count the frames lost before this one."""
        if self._last is not None and self._last.raw != frame.raw:     # else the line doubled it
            self._lost += (frame.number - self._last.number - 1) % 256
        self._last = frame

    def due(self, now: float, is_drained: bool) -> Tuple[List[Packet], Optional[float]]:
        messages, due = self.board_settings.send(now, self.announcement.is_current)
        silent_at = self.idle(now)
        return list(map(self._packet, messages)), silent_at if due is None else min(due, silent_at)

    def _packet(self, message: LayoutMessage) -> Packet:
        data, seq = message.pack(), self._seq
        self._seq = (seq + 1) % 256
        return Packet(wire.encode_raw(message.TYPE, seq, data), message.TYPE, seq, data, message)

    def idle(self, now: float) -> float:
        for kind, (seq, received_at, silent_at) in self._latest.items():
            if now >= silent_at:
                self._latest[kind] = _Latest(seq, received_at,
                                             max(silent_at + _STATUS_PERIOD, now))
                self._on_silence(kind, seq, now - received_at)
        return min(latest.silent_at for latest in self._latest.values())

    def talks(self, now: float) -> bool:
        return now < self._heard_at + self._timeout

    def values(self) -> List[Tuple[str, Any]]:
        return [('frames lost', self._lost), *self.board_settings.values()]
