"""Learns the custom messages of a line from the announcements in its frames."""
import struct
from typing import Any, Iterable, List, Optional, Tuple

from ...framing.announcement import TYPE, Assembly, Chunk, read_announcement
from ...framing.rows import Kind, RowError
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
        """Take a frame; return all custom messages and settings of the line if they have changed,
        else []."""
        chunk = self._chunk(sent, frame)
        text = self._assembly.add(chunk) if chunk else None
        board, parameters = self.line.board, dict(self._configured)
        if text is None or not board.groups:
            return []
        for name, row in read_announcement(text).rows.items():
            group = board.group_of(row)
            rows = parameters.get(group.parameter) or {}
            if name not in rows:
                try:
                    board.read(group.parameter, {**rows, name: row})
                    parameters[group.parameter] = {**rows, name: row}
                except RowError:
                    pass    # the bridge leaves it out, too
        self.line = self.line._replace(parameters=parameters)
        return board.read_all(parameters)

    def _chunk(self, sent: bool, frame: Frame) -> Optional[Chunk]:
        if frame.cause:
            return None
        asked, self._asked = self._asked, (
            sent and frame.number == TYPE and any(
                Kind.FUNCTION in group.kinds for group in self.line.board.groups))
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
