"""A log with a limited rate: a cause that repeats is not logged each time."""
import logging
from typing import Callable, Dict, List

from ..transport import pace


class SparingLog:
    """Logs at most one line for each cause in every `period` seconds, with the link's name.

    The next line of a cause says how many were left out; those of the cause '' are all logged.
    Errors of the logger are ignored: a link must not end because its log cannot be written.
    """

    def __init__(self, link: str, logger: logging.Logger, period: float = 10.0,
                 clock: Callable[[], float] = pace.clock) -> None:
        self._link, self._logger = link, logger
        self._period, self._clock = period, clock
        self._causes: Dict[str, List[float]] = {}   # cause -> [logged at, left out since]

    def info(self, cause: str, text: str) -> None:
        self._log(logging.INFO, cause, text)

    def warn(self, cause: str, text: str) -> None:
        self._log(logging.WARNING, cause, text)

    def error(self, cause: str, text: str) -> None:
        self._log(logging.ERROR, cause, text)

    def _log(self, level: int, cause: str, text: str) -> None:
        now = self._clock()
        last = self._causes.get(cause)
        if cause and last and now - last[0] < self._period:
            last[1] += 1
            return
        left_out = int(last[1]) if last else 0
        self._causes[cause] = [now, 0]
        if left_out:
            text += f' (and {left_out} more like it)'
        try:
            self._logger.log(level, '%s: %s', self._link, text)
        except Exception:  # pylint: disable=broad-except
            pass    # no other place to report it
