"""From bytes that were read to frames in the session, and what is counted of them."""
import traceback
from typing import Any, Callable, Optional

from ..framing.stream import UNKNOWN, Frame, FrameTimer, stamped
from .session import Session
from .sparing_log import SparingLog
from .stamps import Read, Stamps

RX, TX = 0, 1                  # as in SerialMsg
_ANNOUNCING = 5.0              # s after the opening in which a board announces what it sends

Tap = Callable[[str, int, Frame], None]      # gets the link's name, RX or TX, and the frame


class Traffic:
    """The traffic of one link."""

    def __init__(self, name: str, log: SparingLog) -> None:
        self.tap: Optional[Tap] = None     # called with every frame in and out; None: no listener
        self.frames_received = 0           # valid ones
        self.frames_sent = 0
        self.stale = 0                     # bytes dropped because they may be old
        self.reported_errors = 0           # those until the latest report
        self._name, self._log = name, log

    def tapped(self, direction: int, frame: Frame) -> None:
        """Pass a frame to the listener."""
        tap = self.tap      # another thread may set it to None meanwhile
        try:
            if tap:
                tap(self._name, direction, frame)
        except Exception:  # pylint: disable=broad-except
            # Guarded: an error here would look as if the frame had not been sent.
            self._log.error('fault', traceback.format_exc())


class Receiver:
    """Decodes, counts, logs, stamps and passes on what one link receives; in its thread."""

    def __init__(self, session: Session, traffic: Traffic, timer: FrameTimer,
                 stamps: Stamps) -> None:
        self._session, self._traffic, self._timer = session, traffic, timer
        self.stamps = stamps

    def reset(self) -> None:
        """What was received before is dropped, with an incomplete frame."""
        self._session.decoder.reset()
        self._timer.reset()
        self.stamps.reset()

    def take(self, data: bytes, stamp: Any, now: float, is_old: bool = False) -> bool:
        """Take the bytes of one read; return whether there were any, or frames.

        Args:
            is_old: the frames that are complete now are dropped, the bytes are counted. A frame
                may begin in them and end in the next read: without its beginning, and without a
                checksum, its end alone could be taken for another frame.
        """
        decoder, presence = self._session.decoder, self._session.presence
        frames = []
        if data:
            presence.byte_at = now
            frames = decoder.feed(data, Read(stamp, now))
        if decoder.pending:
            frames += self._timer.overdue(presence.byte_at, now)
        if is_old:
            self._traffic.stale += len(data)
        else:
            for frame in frames:
                try:
                    self._deliver(frame, now)
                except Exception:  # pylint: disable=broad-except
                    self._session.log.error('fault', traceback.format_exc())
        return bool(data or frames)

    def due(self) -> Optional[float]:
        """When an incomplete frame is given up; None: there is none."""
        return self._timer.due(self._session.presence.byte_at)

    def _deliver(self, frame: Frame, now: float) -> None:
        """Count, log and pass on one frame, valid or not; its stamp is a `Read`."""
        session, traffic, read = self._session, self._traffic, frame.stamp
        shown = session.shown(stamped(frame, read.stamp)) if traffic.tap else frame
        frame = stamped(frame, self.stamps.of(frame, read))
        cause = UNKNOWN if frame.message is None and not frame.cause else frame.cause
        # The board may still announce a type that is unknown now.
        if cause and (cause != UNKNOWN or session.announcement.on_text is None
                      or now >= session.presence.opened_at + _ANNOUNCING):
            session.errors[cause] += 1
            if frame.cause:
                session.log.warn(cause, f'{cause}: {frame.error}: {frame.raw[:24].hex()}')
        if frame.cause:
            session.damaged(frame, now)
        else:
            traffic.frames_received += 1
            # Another board's bytes may be a frame of an unknown type.
            session.presence.heard(now, frame.message is not None)
            session.received(frame, now)
        if traffic.tap:
            traffic.tapped(RX, shown)
