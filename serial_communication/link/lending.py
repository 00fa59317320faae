"""Lends a link's port to another program, and resets its board."""
import threading
from collections import deque
from typing import Callable, Deque, Optional, Tuple

from ..framing.layout import readable
from ..transport.port import Loan, Port, PortError
from .outcome import LOOK, Refused

LONGEST_LOAN = 10.0    # s, from each call
_LONGEST_NAME = 60     # characters
STALLED = 'the call may have waited while the bridge stalled; call again'
_PATIENCE = 1.5        # s for the link's thread to do a task, and to close the port

Answer = Tuple[bool, str]     # whether it was done; what was done, or why not


class Task:
    """What the link's thread is asked to do: lend the port, end a loan, or reset the board."""

    def __init__(self, why: str, loan: Optional[Loan] = None, line: str = '') -> None:
        self.why = why
        self.loan = loan                # one that is over: end it
        self.line = line                # to reset the board by; '': none
        self.answer: Optional[Answer] = None    # None: not done yet
        self._lock = threading.Lock()
        self._done = threading.Event()

    def finish(self, answer: Answer) -> None:
        """Set the answer; only the first one counts."""
        with self._lock:
            self.answer = self.answer or answer
        self._done.set()

    def wait(self) -> Answer:
        """Wait for the answer; a task that has not begun by then is not done any more."""
        if not self._done.wait(_PATIENCE):
            self.finish((False, 'the link did not confirm it in time, since its port is just '
                         f'being opened or closed; {LOOK}'))
        assert self.answer
        return self.answer


class Lending:
    """Any thread may call `lend` and `reset`; the link's thread then does what has to be done, in
    `step`, and so never while it sends or receives something else.

    A loan ends by itself: whatever happens to who asked for it, the port stays closed for 10 s at
    most, or until no other program has it open. A caller who is told that the port was not lent may
    be wrong for that time.

    Args:
        may_be_old: whether a call that arrives now may have waited while the bridge stalled.
        now: the clock.
    """

    def __init__(self, port: Port, wake: Callable[[], None], may_be_old: Callable[[], bool],
                 now: Callable[[], float]) -> None:
        self.line = ''                # `dtr` or `rts`, which resets the board; '': none does
        # Set by boards, called in the link's thread: what must not be interrupted now, '': nothing.
        self.under_way: Callable[[], str] = lambda: ''
        # Likewise: make the board safe, then `Port.give_up` with this reason. True: for a reset.
        self.let_go: Callable[[str, bool], None] = lambda why, resets: port.give_up(why)
        # Likewise: the board was reset.
        self.was_reset: Callable[[], None] = lambda: None
        self._port = port
        self._wake = wake
        self._may_be_old = may_be_old
        self._now = now
        self._tasks: Deque[Task] = deque()      # from other threads
        self._closing: Optional[Task] = None    # its port is lent as soon as it is closed

    def lend(self, by: str, seconds: float) -> Answer:
        """Close the port and leave it alone for so many seconds from now on, at most
        `LONGEST_LOAN`; 0 ends the loan. The same name may change its loan at any time."""
        return self.ask_for_loan(by, seconds).wait()

    def reset(self) -> Answer:
        """Reset the board by its control line, and open the port again."""
        return self.ask_for_reset().wait()

    def ask_for_loan(self, by: str, seconds: float) -> Task:
        """As `lend`, without waiting for the answer."""
        by = readable(by).strip()[:_LONGEST_NAME]
        loan = Loan(by, self._now() + min(seconds, LONGEST_LOAN))
        refusal = '' if by and seconds >= 0 else \
            f'by is {by!r} and seconds {seconds:g}: a name and 0 … 10 are needed'
        return self._ask(Task(str(loan), loan=loan), refusal, seconds > 0)

    def ask_for_reset(self) -> Task:
        """As `reset`, without waiting for the answer."""
        refusal = ''
        if not self.line:
            refusal = 'no line that resets this board is known (parameter reset_line)'
        elif self._port.is_pty or self._port.is_network:
            refusal = f'the port {self._port.url} has no control lines'
        return self._ask(Task(f'the board is reset by {self.line.upper()}', line=self.line),
                         refusal)

    def _ask(self, task: Task, refusal: str, must_be_new: bool = True) -> Task:
        if not refusal and must_be_new and self._may_be_old():
            refusal = STALLED
        if refusal:
            task.finish(_refused(refusal))
        else:
            self._tasks.append(task)
            self._wake()
        return task

    # -- in the link's thread -----------------------------------------------------------

    def step(self) -> None:
        """Do what was asked for; whether the port is open or not."""
        while self._tasks:
            task = self._tasks.popleft()
            if task.answer is None:
                self._begin(task)
        closing = self._closing
        if closing and not self._port.is_open:
            self._closing = None
            closing.finish((True, f'{closing.loan}') if self._port.is_lent else _refused(
                f'the loan was over before it could be confirmed: {STALLED}'))

    def _begin(self, task: Task) -> None:
        loan = self._port.loan if self._port.is_lent else None
        try:
            if task.loan and self._now() >= task.loan.until:
                if loan and loan.by == task.loan.by:
                    self._port.loan = task.loan
                task.finish((True, 'the port is opened again'))
            elif self._may_be_old():      # the stall may have begun after `_ask`
                task.finish(_refused(STALLED))
            elif loan and (task.loan is None or task.loan.by != loan.by):
                task.finish(_refused(f'the port is {loan}'))
            elif task.loan:
                self._lend(task, task.loan)
            else:
                self._reset(task)
        except (Refused, PortError) as error:
            task.finish(_refused(str(error)))

    def _lend(self, task: Task, loan: Loan) -> None:
        if self._port.is_open:
            self._interrupt(task)
        self._port.loan = loan
        self._closing = task

    def _reset(self, task: Task) -> None:
        if not self._port.is_open:
            task.finish(_refused('the port is closed'))
            return
        self._interrupt(task)
        self._port.pulse(task.line)
        self.was_reset()
        task.finish((True, f'reset by {task.line.upper()}'))

    def _interrupt(self, task: Task) -> None:
        under_way = self.under_way()
        if under_way:
            raise Refused(f'not now: {under_way}', 'under way')
        self.let_go(task.why, bool(task.line))      # this thread closes the port later


def _refused(why: str) -> Answer:
    return False, why
