"""From bytes that were read to frames in the session, and what is counted of them."""
import traceback
from typing import Any, Optional

from ..framing.stream import UNKNOWN, Frame, FrameTimer, stamped
from .session import RX, Session
from .stamps import Read, Stamps


class Receiver:
    """Decodes, counts, logs, stamps and passes on what one link receives; in its thread."""

    def __init__(self, session: Session, timer: FrameTimer, stamps: Stamps) -> None:
        self._session, self._timer, self.stamps = session, timer, stamps

    def reset(self) -> None:
        """What was received before is dropped, with an incomplete frame."""
        self._session.decoder.reset()
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
            self._session.stale += len(data)
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
        session, read = self._session, frame.stamp
        shown = session.shown(stamped(frame, read.stamp)) if session.tap else None
        frame = stamped(frame, self.stamps.of(frame, read))
        if frame.cause and (frame.cause != UNKNOWN or not session.announcement.may_announce(
                now - session.presence.opened_at)):
            session.errors[frame.cause] += 1
            session.log.warn(frame.cause, f'{frame.trouble}: {frame.raw[:24].hex()}')
        if frame.cause:
            session.damaged(frame, now)
        else:
            session.frames_received += 1
            session.presence.heard(now)
            session.received(frame, now)
        if shown:       # somebody listened when the frame came
            session.tapped(RX, shown)
