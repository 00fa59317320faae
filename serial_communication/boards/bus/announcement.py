"""Asks a board for its announcement after each SYNC, one chunk after the other."""
from typing import Callable, Optional

from ...framing.announcement import Assembly, Chunk
from ...link.outcome import NOT_SENT, TIMEOUT
from ...link.sparing_log import SparingLog
from . import wire
from .call import Call

# s before the first question, and after each one without an answer
_PAUSES = 0.0, 0.5, 1.0, 2.0, 4.0, 8.0
_NEVER = float('inf')


class AnnouncementReader:
    """Asks until the text is complete; one for each opening of the port. Any other reply means that
    there is no text. No answer means nothing: then it asks for all of it again, after a pause.

    Args:
        ask: submits the request for the chunk with this index; gets the time, too.
        assembly: takes the chunks.
    """

    def __init__(self, ask: Callable[[int, float], Call], assembly: Assembly,
                 log: SparingLog) -> None:
        self._ask, self._assembly, self._log = ask, assembly, log
        self._call: Optional[Call] = None       # the question that is asked
        self._index = 0
        self._failures = 0          # since a text was complete
        self._ask_at = _NEVER       # the next one

    def begin(self, now: float) -> None:
        """The board may be another one, and what it answers yet another's: ask for all again."""
        if self._call:
            self._failures += 1
        self._call, self._index = None, 0
        self._ask_at = now + _PAUSES[min(self._failures, len(_PAUSES) - 1)]

    def _failed(self, now: float) -> None:
        self._failures += 1
        self.begin(now)
        if self._failures >= len(_PAUSES):
            self._ask_at = _NEVER
            self._log.warn('announcement', 'the board does not answer the question for its '
                           'announcement; what it announced earlier is not used')

    def tick(self, now: float) -> Optional[bytes]:
        """Ask for the next chunk if it is time; return the text that the board announces if it is
        now known and not the latest, else None."""
        if self._call is None and now >= self._ask_at:
            self._call, self._ask_at = self._ask(self._index, now), _NEVER
        outcome = self._call.outcome if self._call else None
        if outcome is None:
            return None
        self._call = None
        if outcome.success:
            return self._take(Chunk.unpack(outcome.data), now)
        if outcome.status == NOT_SENT:
            self._ask_at = now
        elif outcome.status == TIMEOUT or outcome.error_code == wire.NOT_SYNCHRONISED:
            self._failed(now)
        else:
            return self._assembly.whole(b'')
        return None

    def _take(self, chunk: Chunk, now: float) -> Optional[bytes]:
        try:
            text = self._assembly.add(chunk)
        except ValueError as error:
            self._log.warn('announcement', str(error))
            return self._assembly.whole(b'')
        if self._assembly.complete:
            self._failures = 0
            return text
        self._index += 1      # not the chunk's: a board may ignore the index
        self._ask_at = now
        if self._index >= chunk.count:      # one is damaged, or the text has changed
            self._failed(now)
        return None
