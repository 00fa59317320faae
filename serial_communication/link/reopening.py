"""When a port is opened again, and how loud that is."""
from .sparing_log import SparingLog

_SHUTDOWN_TIME = 0.5    # s within which bridge and simulated boards end if stopped together
_BACK_OFF = 0.1, 1.0    # s until the port is opened again: the first pause, the longest


class Reopening:
    """The policy for one port: a loss is logged once it cannot be opened again, or when it is.

    Args:
        url: of the port, for log lines.
    """

    def __init__(self, url: str, log: SparingLog) -> None:
        self.at = 0.0                       # when to open the port
        self.trouble = 'not opened yet'     # why it is closed, or will be
        self.count = 0                      # how often it has been opened
        self._url, self._log = url, log
        self._pause = _BACK_OFF[0]
        self._opened_at = float('-inf')
        self._lost = ''                     # why it was lost; '': logged, or not lost
        self._quiet_until = 0.0

    def lost(self, why: str, now: float) -> None:
        """The open port is gone."""
        self.trouble, self.at = why, max(now, self._opened_at + _BACK_OFF[0])
        self._lost = f'{self._url}: {why}; opening it again when it returns'
        # If everything is stopped together, a simulated board's port may vanish first: no warning.
        self._quiet_until = now + _SHUTDOWN_TIME

    def failed(self, why: str, now: float) -> None:
        """It could not be opened."""
        self.trouble, self.at = why, now + self._pause
        self._pause = min(self._pause * 2, _BACK_OFF[1])
        if now >= self._quiet_until:
            self._log_loss()
            self._log.warn('closed', f'{self._url}: {why}')

    def opened(self, now: float) -> None:
        self._opened_at = now
        self._log_loss()
        self._log.info('opened', f'{self._url}: open')
        self._pause = _BACK_OFF[0]
        self.count += 1

    def _log_loss(self) -> None:
        if self._lost:
            self._log.warn('lost', self._lost)
            self._lost = ''
