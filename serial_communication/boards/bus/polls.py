"""What the link asks by itself: functions, each with its period, and the board's announcement."""
import math
from dataclasses import dataclass
from functools import partial
from typing import Callable, List, Optional

from ...framing.announcement import Assembly, Chunk
from ...link.outcome import NOT_SENT, TIMEOUT
from ...link.sparing_log import SparingLog
from ...transport.pace import Every
from . import wire
from .call import Call, OnSuccess

# s before the first question for the announcement, and after each one without an answer
_PAUSES = 0.0, 0.5, 1.0, 2.0, 4.0, 8.0
# Submits a request: the time, and what is called with the outcome of a success.
Submit = Callable[[wire.Request, wire.Function, float, Optional[OnSuccess]], Call]


@dataclass(eq=False)
class Poll:
    """A function that is called with a period."""

    function: wire.Function
    period: float
    on_success: OnSuccess
    pace: Every     # missed periods are skipped
    latest: Optional[Call] = None


class Polls:
    """All polls of a link. A poll is not submitted while the one before it is outstanding."""

    def __init__(self, submit: Submit) -> None:
        self._submit = submit
        self._polls: List[Poll] = []

    def add(self, function: wire.Function, period: float,
            on_success: OnSuccess) -> Callable[[], None]:
        """Call a function, with zeros as its values, every `period` s. Return what ends that;
        `on_success` may be called once more."""
        poll = Poll(function, period, on_success, Every(period, 0.0))
        self._polls.append(poll)
        return partial(self._polls.remove, poll)

    def start(self, now: float) -> None:
        """The port was opened: all are due at once."""
        for poll in list(self._polls):      # any thread may add one
            poll.pace = Every(poll.period, now - poll.period)

    def tick(self, now: float, is_announced: bool) -> float:
        """Submit what is due, or only what no board announces; return when the next one is."""
        due = math.inf
        for poll in list(self._polls):
            function = poll.function
            if function.announced and not is_announced:
                continue
            if poll.pace.passed(now) and (poll.latest is None or poll.latest.outcome):
                zeros = (0,) * len(function.layout.values)
                poll.latest = self._submit(function.make_request(zeros), function, now,
                                           poll.on_success)
            due = min(due, poll.pace.due)
        return due


class AnnouncementReader:
    """Asks a board after each SYNC for its announcement, one chunk after the other, until the text
    is complete; one for each opening of the port. Any other reply means that there is no text. No
    answer means nothing: then it asks for all of it again, after a pause."""

    def __init__(self, submit: Submit, assembly: Assembly, log: SparingLog) -> None:
        self._submit, self._assembly, self._log = submit, assembly, log
        self._call: Optional[Call] = None       # the question that is asked
        self._index = 0             # of the chunk
        self._failures = 0          # since a text was complete
        self._ask_at = math.inf     # the next one

    def begin(self, now: float) -> None:
        """The board may be another one, and what it answers yet another's: ask for all again."""
        self._failures += self._call is not None
        self._call, self._index = None, 0
        self._ask_at = now + _PAUSES[min(self._failures, len(_PAUSES) - 1)]

    def _failed(self, now: float) -> None:
        self.begin(now)
        if self._failures >= len(_PAUSES):
            self._ask_at = math.inf
            self._log.warn('announcement', 'the board does not answer the question for its '
                           'announcement; what it announced earlier is not used')

    def tick(self, now: float) -> Optional[bytes]:
        """Ask for the next chunk if it is time; return the text that the board announces if it is
        now known and not the latest, else None."""
        if self._call is None and now >= self._ask_at:
            self._call, self._ask_at = self._submit(
                wire.ANNOUNCEMENT.make_request((self._index,)), wire.ANNOUNCEMENT, now, None
            ), math.inf
        outcome = self._call.outcome if self._call else None
        if outcome is None:
            return None
        if outcome.status == TIMEOUT or outcome.error_code == wire.NOT_SYNCHRONISED:
            self._failed(now)
            return None
        self._call = None
        if outcome.success:
            return self._take(Chunk.unpack(outcome.data), now)
        if outcome.status != NOT_SENT:
            return self._assembly.whole(b'')
        self._ask_at = now
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
            self._failures += 1
            self._failed(now)
        return None
