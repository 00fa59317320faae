"""Lends a link's port to another program, and resets its board."""
import time
from typing import Callable, Optional, Tuple

from ..framing.layout import readable
from ..transport.pace import clock
from ..transport.port import Loan, Port, PortError
from .outcome import LOOK, NOT_SENT, TIMEOUT, Outcome, Refused

LONGEST_LOAN = 10.0    # s, from each call
_LONGEST_NAME = 60     # characters
STALLED = 'the call may have waited while the bridge stalled; call again'
_CLOSES_WITHIN = 1.5   # s for the link's thread to take the task and to close the port

Answer = Tuple[bool, str]     # whether it was done; what was done, or an `Outcome.text`: why not


class Lending:
    """Any thread may call `lend` and `reset`; the link's thread then does what has to be done
    while the port is open, in `step`, and so never while it sends or receives something else.

    A loan ends by itself: whatever happens to who asked for it, the port stays closed for 10 s at
    most, or until no other program has it open. A caller who is told that the port was not lent may
    be wrong for that time.

    Args:
        may_be_old: whether a call that arrives now may have waited while the bridge stalled.
    """

    def __init__(self, port: Port, wake: Callable[[], None],
                 may_be_old: Callable[[], bool]) -> None:
        self.line = ''                # `dtr` or `rts`, which resets the board; '': none does
        # Set by boards, called in the link's thread: what must not be interrupted now, '': nothing.
        self.under_way: Callable[[], str] = lambda: ''
        # Likewise: make the board safe, then `Port.give_up` with this reason; whether to reset it.
        self.let_go: Callable[[str, bool], None] = lambda why, resets: port.give_up(why)
        # Likewise: the board was reset.
        self.was_reset: Callable[[], None] = lambda: None
        self._port = port
        self._wake = wake
        self._may_be_old = may_be_old
        self._task: Optional[_Task] = None

    def lend(self, by: str, seconds: float) -> Answer:
        """Close the port and leave it alone for so many seconds from now on, at most
        `LONGEST_LOAN`; 0 ends the loan. The same name may change its loan at any time."""
        by, loan = readable(by).strip()[:_LONGEST_NAME], self._port.loan
        if not by or not seconds >= 0:      # NaN is refused, too
            return _refused(f'by is {by!r} and seconds {seconds:g}: a name and 0 … 10 are needed')
        if loan and loan.by != by and loan.runs:
            return _refused(f'the port is {loan}')
        new = Loan(by, clock() + min(seconds, LONGEST_LOAN))
        if not seconds:
            self._port.end_loan(by)
            return True, 'the port is opened again'
        if not self._port.lend_closed(new):
            failure = self._do(_Task(str(new), loan=new))
            if failure:
                return failure
        deadline = time.monotonic() + _CLOSES_WITHIN
        while not self._port.has_closed():
            if time.monotonic() > deadline:
                self._port.end_loan(by)
                return _refused('the port is just being opened or closed, which takes long')
            time.sleep(0.005)
        loan = self._port.loan
        if not loan or loan.by != by or not loan.runs:
            return _refused(f'the loan was over before it could be confirmed: {STALLED}')
        return True, f'{new} for {min(seconds, LONGEST_LOAN):g} s'

    def reset(self) -> Answer:
        """Reset the board by its control line, and open the port again."""
        if not self.line:
            return _refused('no line that resets this board is known (parameter reset_line)')
        if self._port.is_pty or self._port.is_network:
            return _refused(f'the port {self._port.url} has no control lines')
        failure = self._do(_Task(f'the board is reset by {self.line.upper()}', line=self.line))
        return failure or (True, f'reset by {self.line.upper()}')

    def _do(self, task: '_Task') -> Optional[Answer]:
        """Have the link's thread do a task; return None, or why it was not done."""
        if self._may_be_old():
            return _refused(STALLED)
        self._task = task
        self._wake()
        deadline = time.monotonic() + _CLOSES_WITHIN
        while task.why_not is None:
            if time.monotonic() > deadline or self._task not in (task, None):
                self._task = None       # two tasks at once: at least one of them fails
                return False, Outcome(
                    TIMEOUT, f'the link did not confirm it in time; {LOOK}').text
            time.sleep(0.005)
        return _refused(task.why_not) if task.why_not else None

    def step(self) -> None:
        """In the link's thread, whether the port is open or not."""
        task, self._task = self._task, None
        if task is None:
            return
        if self._may_be_old():      # the stall may have begun after `_do` has asked
            task.why_not = STALLED
            return
        try:
            task.why_not = self._step(task)
        except (Refused, PortError) as error:
            task.why_not = str(error)

    def _step(self, task: '_Task') -> str:
        port = self._port
        if not port.is_open:
            if task.loan and port.lend_closed(task.loan):
                return ''
            return f'the port is {port.loan if port.loan and port.loan.runs else "closed"}'
        under_way = self.under_way()
        if under_way:
            return f'not now: {under_way}'
        self.let_go(task.why, bool(task.line))
        port.loan = task.loan       # this thread, which runs this, closes the port later
        if task.line:
            port.pulse(task.line)
            self.was_reset()
        return ''


def _refused(why: str) -> Answer:
    return False, Outcome(NOT_SENT, why).text


class _Task:
    """What the link's thread is asked to do."""

    def __init__(self, why: str, loan: Optional[Loan] = None, line: str = '') -> None:
        self.why = why
        self.loan = loan
        self.line = line
        self.why_not: Optional[str] = None     # None: not done yet
