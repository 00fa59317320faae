"""Learns the custom messages of a line from the announcements in its frames."""
from typing import Any, Dict, Iterable, List

from ...framing.announced_text import read_announcement
from ...framing.announcement import Assembly, Chunk
from ...framing.custom_messages import RowError
from ...framing.stream import Frame
from .lines import Settings


class Learner:
    """Takes the frames from a board; `line` then has the rows that the board announces, too.

    On the bus it learns nothing: there a chunk is a reply, which only its request tells apart.
    """

    def __init__(self, line: Settings) -> None:
        self.line = line
        self._configured = line.parameters
        self._assembly = Assembly()

    def take(self, frame: Frame) -> List[Any]:
        """Take a frame; return all custom messages of the line if they have changed, else []."""
        try:
            text = self._assembly.take(frame.message) if isinstance(frame.message, Chunk) else None
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


def with_announced(line: Settings, frames: Iterable[Frame]) -> Settings:
    """Return the line with the rows that its board announces last in these frames from it."""
    learner = Learner(line)
    for frame in frames:
        learner.take(frame)
    return learner.line
