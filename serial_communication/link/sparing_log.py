"""A log that says a thing once, and then sparingly, however often it happens."""
import logging
import time
from typing import Callable, Dict, List


class SparingLog:
    """Lines of one link: at most one for each cause in every `period` seconds.

    A line that comes after others were held back says how many they were. Nothing that the
    logger raises reaches the caller: a link must not end of a log that cannot be written.
    """

    def __init__(self, link: str, logger: logging.Logger, period: float = 10.0,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._link = link
        self._logger = logger
        self._period = period
        self._clock = clock
        self._causes: Dict[str, List[float]] = {}   # cause -> [said at, held back since]

    def info(self, cause: str, text: str) -> None:
        self._say(logging.INFO, cause, text)

    def warn(self, cause: str, text: str) -> None:
        self._say(logging.WARNING, cause, text)

    def error(self, cause: str, text: str) -> None:
        self._say(logging.ERROR, cause, text)

    def _say(self, level: int, cause: str, text: str) -> None:
        now = self._clock()
        last = self._causes.get(cause)
        if last is not None and now - last[0] < self._period:
            last[1] += 1
            return
        held_back = int(last[1]) if last else 0
        self._causes[cause] = [now, 0]
        if held_back:
            text += f' (and {held_back} more like it)'
        self._write(level, text)

    def always_info(self, text: str) -> None:
        """A line that its caller is sparing with."""
        self._write(logging.INFO, text)

    def always_warn(self, text: str) -> None:
        """Likewise, a warning."""
        self._write(logging.WARNING, text)

    def _write(self, level: int, text: str) -> None:
        try:
            self._logger.log(level, '%s: %s', self._link, text)
        except Exception:  # pylint: disable=broad-except
            pass    # there is nowhere to say so
