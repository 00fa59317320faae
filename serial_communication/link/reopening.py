"""When a port is opened again, and how loud that is."""
from .sparing_log import SparingLog

_BACK_OFF = 0.1, 1.0    # s until the port is opened again: the first pause, the longest


class Reopening:
    """The policy for the port with this URL."""

    def __init__(self, url: str, log: SparingLog) -> None:
        self.at = 0.0                       # when to open the port
        self.trouble = 'not opened yet'     # why it is closed, or will be
        self.count = 0                      # how often it has been opened
        self._url, self._log = url, log
        self._pause = _BACK_OFF[0]

    def lost(self, why: str, now: float) -> None:
        """The open port is gone."""
        self.trouble, self.at = why, now + self._pause
        self._log.warn('lost', f'{self._url}: {why}; opening it again when it returns')

    def failed(self, why: str, now: float) -> None:
        """It could not be opened."""
        self.trouble, self.at = why, now + self._pause
        self._pause = min(self._pause * 2, _BACK_OFF[1])
        self._log.warn('closed', f'{self._url}: {why}')

    def opened(self) -> None:
        self._log.info('opened', f'{self._url}: open')
        self._pause = _BACK_OFF[0]
        self.count += 1
