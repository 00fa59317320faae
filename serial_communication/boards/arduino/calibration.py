"""Decides from the IMU data whether a board still calibrates its IMU.

A board that calibrates sends no IMU data. But data that was sent before may still be under way
when the calibration begins. And a stall of the bridge or a closed port holds data back: the silence
that follows is not the board's. So a calibration ends only with IMU data after an observed silence.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended.
"""
_SILENCE = 2.0      # s without IMU data: the board calibrates, and later data is new
_UNDER_WAY = 0.05   # s after the request, or a doubt, in which IMU data may be older than that
_READS = 0.25       # s since the latest IMU data, of which one may be lost: the board still reads
_GOES_ON = 5.0      # s of IMU data without such a silence: the board does not calibrate

# Why a calibration is over, as a log line.
BACK = 'IMU data is received again: the calibration is over'
GOES_ON = (f'IMU data was still received {_GOES_ON:g} s after the request to calibrate: the board '
           'does not calibrate; commands are accepted again')


class Calibration:
    """One calibration; it begins when it is created, with the request to the board."""

    def __init__(self, now: float) -> None:
        self.began = now
        self.watch_again(now)

    def watch_again(self, now: float) -> None:
        """What the board did meanwhile is not known: the link has begun anew."""
        self._watched_since = self._last_data = now

    def data_goes_on(self, now: float) -> bool:
        """Whether IMU data shows that the board does not calibrate, so its motor may run."""
        return now - self._last_data < _READS and \
            self._last_data - self._watched_since > _UNDER_WAY

    def imu_data(self, now: float) -> str:
        """IMU data was received: return why the calibration is over now, or ''."""
        silence, self._last_data = now - self._last_data, now
        if silence >= _SILENCE:
            return BACK
        return GOES_ON if now - self._watched_since >= _GOES_ON else ''
