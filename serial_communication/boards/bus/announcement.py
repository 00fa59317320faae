"""Asks a board for its announcement: once after each connect, one chunk after the other."""
from typing import Callable, Optional

from ...framing.announcement import Assembly, Chunk
from ...link.outcome import NOT_SENT
from ...link.sparing_log import SparingLog
from .master import Call

_ROUNDS = 3     # through all chunks; the text may change, or be damaged, while it is read


class AnnouncementQuestion:
    """Asks until the text is complete. Any other reply, or none, means that there is no text.

    Args:
        ask: submits the request for the chunk with this index.
        assembly: takes the chunks.
        log: for warnings.
    """

    def __init__(self, ask: Callable[[int], Call], assembly: Assembly, log: SparingLog) -> None:
        self._ask = ask
        self._assembly = assembly
        self._log = log
        self.restart()

    def restart(self) -> None:
        """The port was opened: ask again."""
        self._call: Optional[Call] = None
        self._index = 0
        self._rounds_left = _ROUNDS

    def step(self) -> Optional[bytes]:
        """Ask for the next chunk if it is time; return the text that the board announces if it is
        now known and not the latest, else None."""
        if not self._rounds_left:
            return None
        if self._call is None:
            self._call = self._ask(self._index)
            return None
        outcome = self._call.outcome
        if outcome is None:
            return None
        self._call = None
        if outcome.status == NOT_SENT:
            return None     # the same chunk is asked for again
        if not outcome.success:
            return self._end(b'')
        return self._take(Chunk.unpack(outcome.data))

    def _take(self, chunk: Chunk) -> Optional[bytes]:
        try:
            text = self._assembly.take(chunk)
        except ValueError as error:
            self._log.warn('announcement', str(error))
            return self._end(b'')
        if self._assembly.complete:
            self._rounds_left = 0
            return text
        self._index += 1
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
