"""Learns the custom messages of a line from the announcements in its frames."""
import struct
from typing import Any, Dict, Iterable, List, Optional, Tuple

from ...boards.description import Numbering
from ...framing.announcement import TYPE, Assembly, Chunk, read_announcement
from ...framing.custom_messages import RowError
from ...framing.stream import Frame
from .lines import Settings


class Learner:
    """Takes the frames of a line; `line` then has the rows that the board announces, too.

    A board that only replies has its chunks in replies, which only their requests tell apart. So of
    such a board both directions are needed.
    """

    def __init__(self, line: Settings) -> None:
        self.line = line
        self._configured = line.parameters
        self._assembly = Assembly()
        self._asked = False     # the latest frame was a request for a chunk

    def take(self, sent: bool, frame: Frame) -> List[Any]:
        """Take a frame; return all custom messages of the line if they have changed, else []."""
        chunk = self._chunk(sent, frame)
        try:
            text = self._assembly.add(chunk) if chunk else None
        except ValueError:
            return []       # too long
        custom = self.line.board.custom
        if text is None or custom is None:
            return []
        rows: Dict[str, Any] = dict(self._configured.get(custom.parameter) or {})
        for name, row in read_announcement(text).rows.items():
            if name not in rows:
                try:
                    custom.read({**rows, name: row})
                    rows[name] = row
                except RowError:
                    pass    # the bridge leaves it out, too
        self.line = self.line._replace(
            parameters={**self._configured, custom.parameter: rows})
        return custom.read(rows)

    def _chunk(self, sent: bool, frame: Frame) -> Optional[Chunk]:
        if frame.cause:
            return None
        asked, self._asked = self._asked, (
            sent and self.line.board.numbering is Numbering.FUNCTION and frame.number == TYPE)
        if isinstance(frame.message, Chunk):
            return frame.message
        try:
            return Chunk.unpack(frame.data) if asked and not sent else None
        except struct.error:
            return None     # the reply is an error


def with_announced(line: Settings, frames: Iterable[Tuple[bool, Frame]]) -> Settings:
    """Return the line with the rows that its board announces last in these (sent, frame)."""
    learner = Learner(line)
    for sent, frame in frames:
        learner.take(sent, frame)
    return learner.line
