"""The settings of one board: which values are wanted, and which the board has confirmed."""
import threading
from copy import copy
from typing import Any, Callable, Dict, Iterable, List, Optional, Tuple

from ..framing.layout import shortest
from ..framing.rows import Setting
from ..framing.stream import Decoder
from ..transport.pace import Allowance
from .sparing_log import SparingLog

_RATE = 5, 15.0            # frames at once, and then a second: never over 20 in one second
_PAUSES = 0.2, 1.0         # s between two tries: at first, and later
_TRIES = 5                 # with the first of these pauses
_WARNING = 9               # tries until one warning: the board may be starting at the first ones
_ANSWERED = 3              # tries: a board that reports another value then limits it


class State:
    """One setting. For displays: a copy."""

    def __init__(self, row: Setting) -> None:
        self.row = row
        self.value: Any = None      # that the board uses; None: not known
        self.wanted: Any = None     # None: the board's own value stands
        self.again()

    def again(self) -> None:
        """The board has to confirm the wanted value anew."""
        self.confirmed = self.limited = False
        self.tries = 0
        self.due = 0.0

    @property
    def is_settled(self) -> bool:
        """Whether the board has confirmed the wanted value, or limited it."""
        return self.wanted is None or self.confirmed or self.limited


class BoardSettings:
    """A wanted value is sent until the board reports it, and again after the board has lost it.

    Any thread may call any method. Times are monotonic.

    Args:
        decoder: of the link; it gets the messages of the settings.
        wake: called when there is something to send.
    """

    def __init__(self, log: SparingLog, decoder: Decoder, wake: Callable[[], None]) -> None:
        # Called by any thread when rows or values have changed; must not wait.
        self.on_change: Callable[[], None] = lambda: None
        self.wanted: Dict[str, Any] = {}     # by name, also of rows that are not there now
        self._states: Dict[str, State] = {}
        self._allowance = Allowance(*_RATE)
        self._log, self._decoder, self._wake = log, decoder, wake
        self._changed = threading.Condition()

    # -- rows and wanted values -----------------------------------------------------------

    def add(self, row: Setting) -> Callable[[], None]:
        """Add a row; return what removes it."""
        with self._changed:
            state = self._states[row.name] = State(row)
            self._decoder.add_message(row.message)
        self.want(row.name, self.wanted.get(row.name))

        def remove() -> None:
            with self._changed:
                if self._states.get(row.name) is state:
                    del self._states[row.name]
                    self._decoder.remove_message(row.message)
            self.on_change()

        return remove

    def want(self, name: str, value: Any) -> None:
        """Send this value until the board has it; None: the board's own stands.

        A value that is not allowed is refused with a warning.
        """
        with self._changed:
            state = self._states.get(name)
            if state is None:
                return      # the row has just gone
            try:
                value = None if value is None else state.row.checked(value)
            except ValueError as error:
                self._log.warn(f'setting {name}', f'the setting {name} cannot be {value!r}: '
                               f'it {error}')
                return
            if value is not None:
                self.wanted[name] = value
            if value != state.wanted or not state.confirmed:
                state.wanted = value
                state.again()
        self._wake()
        self.on_change()

    def wait(self, names: Iterable[str], seconds: float) -> None:
        """Wait until the board has confirmed or limited these settings, at most so long."""
        with self._changed:
            states = [self._states[name] for name in names if name in self._states]
            self._changed.wait_for(lambda: all(state.is_settled for state in states), seconds)

    # -- for the link's thread ------------------------------------------------------------

    def reset(self) -> None:
        """The board may be another one, or have other values: nothing is known or confirmed."""
        with self._changed:
            for state in self._states.values():
                state.value = None
                state.again()
        self.on_change()

    def received(self, message: Any, is_current: bool) -> None:
        """The board uses this value.

        Args:
            is_current: whether the announced rows are known to be those of the board.
        """
        with self._changed:
            state = next((each for each in self._states.values()
                          if each.row.message is type(message)), None)
            if state is None or state.row.announced and not is_current:
                return
            value = shortest(message[1]) if isinstance(message[1], float) else message[1]
            before, was_settled = state.value, state.is_settled
            state.value = value
            if value == state.wanted:
                # Without a try, the report may have been under way while an older value was sent.
                state.confirmed |= state.tries > 0
            elif state.confirmed:
                # The board has started again, so it has lost the others, too.
                for each in self._states.values():
                    each.again()
                self._wake()
            else:
                state.limited = state.tries >= _ANSWERED
            self._changed.notify_all()
        if value != before or not (was_settled and state.is_settled):
            self.on_change()

    def send(self, now: float, is_current: bool) -> Tuple[List[Any], Optional[float]]:
        """What is to be sent now, and when to call again, or None.

        Args:
            is_current: as for `received`.
        """
        with self._changed:
            waiting = [state for state in self._states.values()
                       if state.wanted is not None and not state.confirmed
                       and (is_current or not state.row.announced)]
            messages = []
            for state in sorted(waiting, key=lambda state: state.due):
                if now >= state.due and self._allowance.take(now):
                    state.tries += 1
                    state.due = now + _PAUSES[state.tries >= _TRIES]
                    self._warn(state)
                    messages.append(state.row.message(state.row.number, state.wanted))
            # What the allowance kept is due when there is one more.
            return messages, min((state.due if state.due > now else now + 1 / _RATE[1]
                                  for state in waiting), default=None)

    def _warn(self, state: State) -> None:
        if state.tries == _WARNING:
            uses = 'is silent about it' if state.value is None else f'uses {state.value}'
            self._log.warn(f'setting {state.row.name}', f'the board has not confirmed '
                           f'{state.row.name} = {state.wanted}, it {uses}; it is sent again each '
                           'second')

    # -- for displays -----------------------------------------------------------------------

    def shown(self) -> Dict[str, State]:
        """All settings, in the order of their names."""
        with self._changed:
            return {name: copy(state) for name, state in sorted(self._states.items())}

    def values(self) -> List[Tuple[str, Any]]:
        """For /diagnostics; empty without rows."""
        shown = self.shown()
        return [] if not shown else [
            ('settings', ', '.join(f'{name}={_text(each.value)}' for name, each in shown.items())),
            ('settings unconfirmed', ', '.join(
                f'{name}={_text(each.wanted)}' for name, each in shown.items()
                if each.wanted is not None and not each.confirmed))]


def _text(value: Any) -> str:
    return '?' if value is None else \
        f'{value:.9g}' if isinstance(value, float) else str(value).lower()
