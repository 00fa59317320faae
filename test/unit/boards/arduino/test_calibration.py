"""When a calibration is over; the tests set the time."""
import pytest

from serial_communication.boards.arduino.calibration import BACK, GOES_ON, Calibration

STEP = 0.1


@pytest.fixture
def calibration():
    """A calibration that begins at 0.0."""
    return Calibration(0.0)


def watch(calibration, begin, end, data_every=None):
    """Call it from `begin` to `end` as a link does, with IMU data every `data_every` s, or without.

    Returns the first reason why it is over, and when.
    """
    steps = round((end - begin) / STEP)
    for step in range(1, steps + 1):
        now = begin + (end - begin) * step / steps
        if data_every and step % round(data_every / STEP) == 0:
            why = calibration.imu_data(now)
            if why:
                return why, now
    return None, end


def test_imu_data_after_a_silence_ends_it(calibration):
    assert watch(calibration, 0.0, 310.0) == (None, 310.0)
    assert calibration.imu_data(310.0) is BACK


def test_imu_data_under_way_at_the_begin_does_not_end_it(calibration):
    assert watch(calibration, 0.0, 1.5, data_every=0.1) == (None, 1.5)
    assert watch(calibration, 1.5, 3.4) == (None, 3.4)
    assert not calibration.imu_data(3.4), 'after 1.9 s'
    assert watch(calibration, 3.4, 5.5) == (None, 5.5)
    assert calibration.imu_data(5.5) is BACK


def test_only_received_data_shows_that_the_board_does_not_calibrate(calibration):
    calibration.watch_again(0.4)
    assert not calibration.data_goes_on(0.41)
    calibration.watch_again(1.0)
    assert not calibration.data_goes_on(1.01)
    calibration.imu_data(1.1)
    assert calibration.data_goes_on(1.15) and not calibration.data_goes_on(1.36)


def test_imu_data_for_5_s_without_a_silence_ends_it(calibration):
    why, now = watch(calibration, 0.0, 20.0, data_every=0.1)
    assert why is GOES_ON and now == pytest.approx(5.0, abs=0.11)


def test_the_time_of_a_stall_or_a_closed_port_does_not_count(calibration):
    assert watch(calibration, 0.0, 0.5) == (None, 0.5)
    calibration.watch_again(60.0)
    assert not calibration.imu_data(60.1)
    why, now = watch(calibration, 60.1, 80.0, data_every=0.1)
    assert why is GOES_ON and now == pytest.approx(65.0, abs=0.11)
