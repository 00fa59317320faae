"""Whether a board still calibrates its IMU, as far as its IMU data can tell.

A board that calibrates sends no IMU data. But data from before may still be under way as the
calibration begins, and what a stall of the bridge or a closed port kept back says nothing of the
board. So only IMU data after a silence that was watched ends the calibration.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended.
"""
import enum
from typing import Optional

_SILENCE = 2.0      # s without IMU data: now the board calibrates, and later data is new
_UNDER_WAY = 0.05   # s in which IMU data may come that the board sent before
_READS = 0.1        # s since the latest IMU data in which the board counts as reading
_GOES_ON = 5.0      # s of IMU data without such a silence: the board does not calibrate


class End(enum.Enum):
    """Why a calibration is over, for a person."""

    BACK = 'IMU data is back: the calibration is over'
    GOES_ON = (f'IMU data has gone on for {_GOES_ON:g} s since the calibration was asked for: the '
               'board does not calibrate; taking commands again')
    TIMEOUT = 'no end of the calibration within {:g} s; taking commands again'   # its timeout


class Calibration:
    """One calibration, from the packet that asks for it.

    Args:
        timeout: s after which it is over in any case.
    """

    def __init__(self, timeout: float, now: float) -> None:
        self._began = now
        self._due = now + timeout
        self._watched_since = now    # or later, by the time that does not count
        self._last_data = now        # likewise

    def data_goes_on(self, now: float) -> bool:
        """Whether the board seems not to calibrate, but to read, and its motor may run."""
        return now - self._last_data < _READS and self._last_data - self._began > _UNDER_WAY

    def look(self, now: float) -> Optional[End]:
        """Why it is over without IMU data, or None."""
        return None if now < self._due else End.TIMEOUT

    def stalled(self, seconds: float, now: float) -> None:
        """The bridge stalled for so long: that time counts as neither."""
        self._watched_since = min(self._watched_since + seconds, now)
        self._last_data = min(self._last_data + seconds, now)

    def port_opened(self, now: float) -> None:
        """What the board did while the port was closed is not known."""
        self._watched_since = self._last_data = now

    def imu_data(self, now: float) -> Optional[End]:
        """IMU data has come: why it is over now, or None."""
        silence = now - self._last_data
        self._last_data = now
        if silence >= _SILENCE:
            return End.BACK
        return End.GOES_ON if now - self._watched_since >= _GOES_ON else None
