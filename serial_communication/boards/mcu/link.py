"""The link to the sensor board: counts lost frames and reports when the board falls silent."""
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Tuple, Type

from ...framing.announcement import Chunk
from ...framing.layout import LayoutMessage
from ...framing.settings import SettingMessage
from ...framing.stream import CHECKSUM, IMPLAUSIBLE, LENGTH, Frame
from ...link.link import OK, WARN, Link, Refused
from ...transport.output_watch import LONGEST_WAIT, OutputWatch
from ...transport.port import Port, PortBusy
from . import wire

_STATUS_PERIOD = 1.0   # s between two reports of silence
_DOUBLED = 0.01        # s; the same bytes again within this are one frame, doubled on the line


class _Latest(NamedTuple):
    """The latest message of one TYPE."""

    kind: Optional[Type[LayoutMessage]]
    seq: int
    received_at: float
    silent_at: float     # when its absence is reported next


class McuLink(Link):
    """Receives frames, and sends settings alone.

    Args:
        timeout: s without a valid frame after which the board counts as silent.
        network_silence: s without a byte after which a network port is opened again; 0: never.
        messages: classes of custom messages.
        on_status: called with the (message, seq, stamp) of each valid frame.
        on_silence: called once a second with (class, seq, age) for each class of message that the
            board has sent and no longer sends: the last seq, and the seconds since that message.
            The class is None until the board has sent a built-in message, and the age counts from
            the start, or from the latest custom message.
        link_arguments: frame_timeout, clock, board_time and logger, as for `Link`.
    """

    def __init__(self, port: Port, timeout: float = 1.0,
                 on_status: Optional[Callable[[Any, int, Any], None]] = None,
                 on_silence: Optional[
                     Callable[[Optional[Type[LayoutMessage]], int, float], None]] = None,
                 network_silence: float = 5.0, messages: Iterable[Type[LayoutMessage]] = (),
                 **link_arguments: Any) -> None:
        super().__init__('mcu', port, wire.Decoder(messages), **link_arguments)
        self.frames_lost = 0
        self.duplicates = 0
        self.checksum_errors = 0        # those before the frame that is delivered
        self.silent = True              # no message of any class is received
        self._timeout = timeout
        self._network_silence = network_silence
        self._on_status = on_status
        self._on_silence = on_silence
        self._last: Optional[Frame] = None      # since the port opened
        self._last_at = 0.0                     # when it was received
        self._seq = 0                           # of the next frame to the board
        self._watch = OutputWatch(port)
        now = self.now()
        # By TYPE; by None until the board has sent a message.
        self._latest: Dict[Optional[int], _Latest] = {None: _Latest(None, 0, now, now + timeout)}

    def opened(self, now: float) -> None:
        self._last = None

    def received(self, frame: Frame, now: float) -> None:
        message = frame.message
        if self._follow_seq(frame, now):
            return
        if isinstance(message, Chunk):
            self.announcement.add(message)
        elif isinstance(message, SettingMessage):
            self.board_settings.received(message, self.announcement.is_current)
        # None: a valid frame of an unknown type
        elif message is not None and not isinstance(message, wire.Time):
            self.silent = False
            if frame.type in wire.MESSAGES:
                self._latest.pop(None, None)
            elif None in self._latest:      # custom messages have no status of their own
                self._latest[None] = _Latest(None, 0, now, now + self._timeout)
            self._latest[frame.type] = _Latest(type(message), frame.number, now,
                                               now + self._timeout)
            if self._on_status and not self.announcement.holds_back(message):
                self.connection.guarded(self._on_status, message, frame.number, frame.stamp)

    def damaged(self, frame: Frame, now: float) -> None:
        # A status reports the errors before its own frame. The decoder has already counted all
        # errors of the read, also those of later frames.
        self.checksum_errors += frame.cause == CHECKSUM
        if frame.cause in (LENGTH, IMPLAUSIBLE):     # its CRC matches, so its SEQ counts
            self._follow_seq(frame, now)

    def _follow_seq(self, frame: Frame, now: float) -> bool:
        """Count the frames lost before this one; return whether the line has only doubled it, which
        is counted instead."""
        last = self._last
        if last is not None and last.raw == frame.raw and now < self._last_at + _DOUBLED:
            self.duplicates += 1
            return True
        if last is not None and last.raw != frame.raw:
            self.frames_lost += (frame.number - last.number - 1) % 256
        self._last, self._last_at = frame, now
        return False

    def tick(self, now: float) -> float:
        due = self.idle(now)
        others = (self.board_settings.send(now, self._send, self.announcement.is_current),
                  self.check_silence(now, self._network_silence))
        return min([due, *(other for other in others if other is not None)])

    def _send(self, message: SettingMessage) -> None:
        if self._watch.waiting_for(self.now()) > LONGEST_WAIT:
            raise Refused('the port takes no data', 'busy')
        data = message.pack()
        frame = wire.encode_raw(message.TYPE, self._seq, data)
        try:
            self.send(frame, message.TYPE, self._seq, data, message)
        except PortBusy as busy:
            raise Refused(str(busy), 'busy') from None
        self._watch.written += len(frame)
        self._seq = (self._seq + 1) % 256

    def idle(self, now: float) -> float:
        for type_, (kind, seq, received_at, silent_at) in self._latest.items():
            if now >= silent_at:
                self._latest[type_] = _Latest(kind, seq, received_at,
                                              max(silent_at + _STATUS_PERIOD, now))
                if all(now >= latest.received_at + self._timeout
                       for latest in self._latest.values()):
                    self.silent = True
                if self._on_silence:
                    self._on_silence(kind, seq, now - received_at)
        return min(latest.silent_at for latest in self._latest.values())

    def condition(self, now: float) -> Tuple[int, str]:
        if not self.port.is_open:
            return super().condition(now)
        silence = self.presence.meaning(now) or 'the board is silent'
        return (WARN, f'open, {silence}') if self.silent else (OK, 'open')

    def talks(self, now: float) -> Optional[bool]:
        return not self.silent

    def extra_values(self) -> List[Tuple[str, Any]]:
        return [('frames lost', self.frames_lost), ('frames doubled', self.duplicates)]
