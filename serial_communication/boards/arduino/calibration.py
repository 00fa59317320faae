"""Decides from the IMU data whether a board still calibrates its IMU.

A board that calibrates sends no IMU data. But data that was sent before may still be under way
when the calibration begins. And a stall of the bridge or a closed port holds data back: the silence
that follows is not the board's. So a calibration ends only with IMU data after an observed silence.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended.
"""
import enum
from typing import Optional

_SILENCE = 2.0      # s without IMU data: the board calibrates, and later data is new
_UNDER_WAY = 0.05   # s after the request in which IMU data may be older than the request
_READS = 0.1        # s since the latest IMU data for which the board counts as reading
_GOES_ON = 5.0      # s of IMU data without such a silence: the board does not calibrate


class End(enum.Enum):
    """Why a calibration is over, as a log line."""

    BACK = 'IMU data is received again: the calibration is over'
    RESET = 'the board was reset: the calibration is over'
    GOES_ON = (f'IMU data was still received {_GOES_ON:g} s after the request to calibrate: the '
               'board does not calibrate; commands are accepted again')
    TIMEOUT = ('the calibration did not end within {:g} s; commands are accepted again; check the '
               'board')       # with the timeout


class Calibration:
    """One calibration; it begins when it is created, with the request to the board.

    Args:
        timeout: s after which it is over in any case.
    """

    def __init__(self, timeout: float, now: float) -> None:
        self._began = now
        self._timeout_at = now + timeout
        # Both begin again when the link does.
        self._watched_since = now
        self._last_data = now
        self._received_at = float('-inf')

    def data_goes_on(self, now: float) -> bool:
        """Whether IMU data shows that the board does not calibrate, so its motor may run."""
        return now - self._received_at < _READS and self._received_at - self._began > _UNDER_WAY

    def check_timeout(self, now: float) -> Optional[End]:
        """`End.TIMEOUT` if it has lasted too long, else None."""
        return None if now < self._timeout_at else End.TIMEOUT

    def watch_again(self, now: float) -> None:
        """What the board did meanwhile is not known: the link has begun anew."""
        self._watched_since = self._last_data = now

    def imu_data(self, now: float) -> Optional[End]:
        """IMU data was received: return why the calibration is over now, or None."""
        silence = now - self._last_data
        self._last_data = self._received_at = now
        if silence >= _SILENCE:
            return End.BACK
        return End.GOES_ON if now - self._watched_since >= _GOES_ON else None
