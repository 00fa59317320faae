"""When a calibration is over: rules with a clock of the test's own."""
import pytest

from serial_communication.boards.arduino.calibration import Calibration, End

LOOK_PERIOD = 0.1


@pytest.fixture
def calibration():
    """One that began at 0.0."""
    return Calibration(900.0, 0.0)


def watch(calibration, begin, end, data_every=None):
    """Look at it from `begin` to `end` as a link does, with IMU data meanwhile or without; the
    first reason why it is over, and when."""
    steps = round((end - begin) / LOOK_PERIOD)
    for step in range(1, steps + 1):
        now = begin + (end - begin) * step / steps
        why = calibration.look(now)
        if not why and data_every and step % round(data_every / LOOK_PERIOD) == 0:
            why = calibration.imu_data(now)
        if why:
            return why, now
    return None, end


def test_data_after_a_silence_ends_it(calibration):
    assert watch(calibration, 0.0, 310.0) == (None, 310.0)
    assert calibration.imu_data(310.0) is End.BACK


def test_data_that_was_under_way_ends_nothing(calibration):
    assert watch(calibration, 0.0, 1.5, data_every=0.1) == (None, 1.5)
    assert watch(calibration, 1.5, 3.4) == (None, 3.4)
    assert calibration.imu_data(3.4) is None, 'after 1.9 s'
    assert watch(calibration, 3.4, 5.5) == (None, 5.5)
    assert calibration.imu_data(5.5) is End.BACK


def test_data_that_goes_on_for_5_s_ends_it(calibration):
    why, now = watch(calibration, 0.0, 20.0, data_every=0.1)
    assert why is End.GOES_ON and now == pytest.approx(5.0, abs=0.11)


@pytest.mark.parametrize('stall', [0.4, 1.5, 10.0, 600.0])
def test_the_time_of_a_stall_is_no_silence(calibration, stall):
    assert watch(calibration, 0.0, 0.2, data_every=0.1) == (None, 0.2)
    now = 0.2 + stall
    calibration.stalled(stall, now)
    assert calibration.imu_data(now) is None
    assert watch(calibration, now, now + 1.9) == (None, now + 1.9)
    assert calibration.imu_data(now + 1.9) is None
    assert watch(calibration, now + 1.9, now + 4.0) == (None, now + 4.0)
    assert calibration.imu_data(now + 4.0) is End.BACK


def test_the_time_of_a_stall_is_no_time_in_which_data_went_on(calibration):
    assert watch(calibration, 0.0, 2.0, data_every=0.1) == (None, 2.0)
    calibration.stalled(10.0, 12.0)
    assert calibration.imu_data(12.0) is None
    why, now = watch(calibration, 12.0, 30.0, data_every=0.1)
    assert why is End.GOES_ON and now == pytest.approx(15.0, abs=0.11)


def test_what_the_board_does_while_the_port_is_closed_is_not_known(calibration):
    assert watch(calibration, 0.0, 0.5) == (None, 0.5)
    calibration.port_opened(60.0)
    assert calibration.look(60.1) is None and calibration.imu_data(60.1) is None
    why, now = watch(calibration, 60.1, 80.0, data_every=0.1)
    assert why is End.GOES_ON and now == pytest.approx(65.0, abs=0.11)


def test_it_is_over_after_its_timeout_in_any_case(calibration):
    assert watch(calibration, 0.0, 899.9)[0] is None
    assert calibration.look(900.0) is End.TIMEOUT


def test_a_stall_that_began_before_the_calibration_counts_from_its_beginning(calibration):
    calibration.stalled(60.0, 1.0)
    assert watch(calibration, 1.0, 3.1) == (None, 3.1)
    assert calibration.imu_data(3.1) is End.BACK
