"""Asks a board for its announcement after each SYNC, one chunk after the other."""
from typing import Callable, Optional

from ...framing.announcement import Assembly, Chunk
from ...link.outcome import NOT_SENT, TIMEOUT
from ...link.sparing_log import SparingLog
from . import wire
from .call import Call

# s before the first question, and after each one without an answer
_PAUSES = 0.0, 0.5, 1.0, 2.0, 4.0, 8.0
_ROUNDS = 3     # through all chunks; the text may change, or be damaged, while it is read


class AnnouncementReader:
    """Asks until the text is complete. Any other reply means that there is no text.

    A question without an answer means nothing: it is asked again, with growing pauses. A board that
    replies that it is not synchronised has not answered, either.

    Args:
        ask: submits the request for the chunk with this index.
        assembly: takes the chunks.
        log: for warnings.
    """

    def __init__(self, ask: Callable[[int], Call], assembly: Assembly, log: SparingLog) -> None:
        self._ask = ask
        self._assembly = assembly
        self._log = log
        self.opened()

    def opened(self) -> None:
        """The port was opened; `restart` follows."""
        self._call: Optional[Call] = None
        self._is_old = False     # `_call` was asked before `restart`
        self._unanswered = 0     # questions in a row
        self._rounds_left = 0

    def restart(self, now: float) -> None:
        """The board may be another one: ask for the whole text."""
        self._index = 0
        self._rounds_left = _ROUNDS
        self._is_old = self._call is not None
        self._ask_at = now + _PAUSES[self._unanswered]

    def step(self, now: float) -> Optional[bytes]:
        """Ask for the next chunk if it is time; return the text that the board announces if it is
        now known and not the latest, else None."""
        if not self._rounds_left:
            return None
        if self._call is None:
            if now >= self._ask_at:
                self._call = self._ask(self._index)
            return None
        outcome = self._call.outcome
        if outcome is None:
            return None
        is_old, self._call, self._is_old = self._is_old, None, False
        if outcome.status == NOT_SENT:
            return None     # the same chunk is asked for again
        if outcome.status == TIMEOUT or outcome.error_code == wire.NOT_SYNCHRONISED:
            self._ask_again(now)
            return None
        self._unanswered = 0
        if is_old:
            return None     # it may be another board's
        if not outcome.success:
            return self._end(b'')
        return self._take(Chunk.unpack(outcome.data))

    def _ask_again(self, now: float) -> None:
        if self._unanswered + 1 < len(_PAUSES):
            self._unanswered += 1
            self._ask_at = now + _PAUSES[self._unanswered]
            return
        self._rounds_left = 0
        self._log.warn('announcement', 'the board does not answer the question for its '
                       'announcement; what it announced earlier is not used')

    def _take(self, chunk: Chunk) -> Optional[bytes]:
        try:
            text = self._assembly.add(chunk)
        except ValueError as error:
            self._log.warn('announcement', str(error))
            return self._end(b'')
        if self._assembly.complete:
            self._rounds_left = 0
            return text
        self._index += 1      # not the chunk's: a board may ignore the index
        if self._index >= chunk.count:
            self._index = 0
            self._rounds_left -= 1
            if not self._rounds_left:
                self._log.warn('announcement', 'the CRC of the announcement does not match its '
                               f'text in {_ROUNDS} rounds; it is ignored')
                return self._end(b'')
        return None

    def _end(self, text: bytes) -> Optional[bytes]:
        self._rounds_left = 0
        return self._assembly.whole(text)
