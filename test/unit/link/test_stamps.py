"""Stamps of frames with the board's time: their values by given times."""
import time
from types import SimpleNamespace

import pytest

from board_rows import car_messages
from serial_communication.boards.arduino import wire as arduino
from links import ArduinoLink
from serial_communication.framing.board_time import LEAST_POINTS
from serial_communication.transport.port import Port

BYTE = 10.0 / 115200     # s on the wire
GROUP = 12               # bytes of TIME and TICKS
AHEAD = 5000.0           # s that the stamps are ahead of the monotonic clock
PERIOD = 0.1             # s between two measurements
DELAY = 0.002            # s from the measurement to the arrival of the last byte, at least
KEYS = 'board clock [ppm]', 'read delay p50 [ms]', 'read delay max [ms]', 'clock errors'


class Car:
    """A link to the car, and a clock of the test: no thread, no port."""

    def __init__(self, has_baud=True, **options):
        self.got = []
        self.link = ArduinoLink(Port('/dev/none'),
                                on_message=lambda *got: self.got.append(got), **options)
        self.link.port._opened = SimpleNamespace(has_baud=has_baud)
        self.now = 100.0

    def time(self, count):
        """TIME with the board's time of now."""
        return arduino.encode(arduino.Time(round(self.now * 1e6), count))

    def read(self, wire, late=DELAY):
        """The link reads these bytes so many s later than now; return the stamps, by the
        monotonic clock, of what it passes on."""
        self.got.clear()
        at = self.now + late
        self.link.receiver.take(wire, at + AHEAD, at)
        return [stamp - AHEAD for _message, stamp in self.got]

    def measure(self, late=DELAY, behind=b''):
        """Measure, and return the difference of the stamp and the measurement."""
        self.now += PERIOD
        return self.read(self.time(1) + arduino.encode(arduino.Ticks(1)) + behind,
                         late)[0] - self.now

    def settle(self, count=2 * LEAST_POINTS, **options):
        """Measure until the clock is known."""
        for _ in range(count):
            self.measure(**options)

    def values(self):
        return {key: value for key, value in self.link.report(time.monotonic()).values
                if key in KEYS}


@pytest.fixture
def car():
    return Car()


def test_the_stamp_is_that_of_the_read_until_the_clock_is_known_then_of_the_measurement(car):
    late = [car.measure(0.03 if index % 2 else DELAY) for index in range(30)]
    assert late[:9] == pytest.approx([DELAY, 0.03] * 4 + [DELAY])
    assert late[-10:] == pytest.approx([DELAY - GROUP * BYTE] * 10, abs=1e-4)


def test_all_packets_of_one_time_have_one_stamp(car):
    car.settle()
    wire = [arduino.encode(message) for message in (
        arduino.Ticks(1), arduino.Voltage(12.0), arduino.SteeringAngle(3), arduino.Ticks(2))]
    stamps = car.read(car.time(3) + b''.join(wire), late=0.02)
    assert len(stamps) == 4 and len(set(stamps[:3])) == 1
    assert stamps[3] == pytest.approx(car.now + 0.02)


@pytest.mark.parametrize('has_baud, on_the_wire', [(True, GROUP * BYTE), (False, 0.0)])
def test_the_wire_time_up_to_the_read_is_taken_off_but_on_a_network(has_baud, on_the_wire):
    car = Car(has_baud)
    more = arduino.encode(arduino.LOGS[1]('x' * 200))
    late = 10 * DELAY + len(more) * BYTE * has_baud
    car.settle(late=late, behind=more)
    assert car.measure(late, more) == pytest.approx(10 * DELAY - on_the_wire, abs=1e-4)


def test_the_clock_is_learnt_anew_where_the_link_begins_anew(car):
    car.settle()
    assert car.measure(0.02) < 0.01
    car.link.receiver.reset()
    assert [car.measure(0.02) for _ in range(9)] == pytest.approx([0.02] * 9)


def test_a_frame_over_1_s_late_has_the_stamp_of_its_read_and_is_counted_and_logged(car, caplog):
    car.settle()
    car.now += 0.9
    for late in (0.5, 0.9, 1.3):      # each less than 1 s after the one before
        car.now += 0.01
        got = car.read(car.time(1) + arduino.encode(arduino.Ticks(1)), late)
    assert got == pytest.approx([car.now + 1.3])
    assert car.values()['clock errors'] == 2      # TIME and its packet
    assert len(caplog.messages) == 1


def test_diagnostics_show_the_clock_only_of_a_board_that_sends_its_time(car):
    car.measure()
    assert car.values() == {**dict.fromkeys(KEYS, '-'), 'clock errors': 0}
    car.settle(200)
    car.measure(0.05)
    values = car.values()
    assert values['clock errors'] == 0 and abs(float(values['board clock [ppm]'])) < 20
    assert float(values['read delay p50 [ms]']) == pytest.approx(1e3 * GROUP * BYTE, abs=0.1)
    assert float(values['read delay max [ms]']) == pytest.approx(50, abs=3)


def test_without_board_time_the_clock_is_ignored():
    car = Car(board_time=False)
    assert [car.measure(0.02 if index % 2 else DELAY) for index in range(30)] == pytest.approx(
        [DELAY, 0.02] * 15)
    assert car.values() == {}


def test_a_row_with_the_boards_time_has_its_stamp():
    row, = car_messages({'force': {'type': 32, 'ros_type': 'a/B', 'layout': '<Ih',
                                   'fields': ['@time', 'x']}})
    car = Car(messages=[row.message])
    for _ in range(30):
        car.now += PERIOD
        car.read(arduino.encode(row.message(round(car.now * 1e6), 5)))
    assert car.read(arduino.encode(row.message(round(car.now * 1e6), 5)), 0.05) == pytest.approx(
        [car.now + DELAY - 9 * BYTE], abs=1e-4)


def test_a_step_of_the_clock_of_the_stamps_changes_no_difference(car):
    """As of the system's clock, or of simulated time: the read has it, and so has the stamp."""
    car.settle()
    car.now += PERIOD
    for step in 0.0, -3600.0, 1e9:
        car.link.receiver.take(car.time(1) + arduino.encode(arduino.Ticks(1)),
                               car.now + 0.02 + step, car.now + 0.02)
        assert car.got[-1][1] == pytest.approx(car.now + step + DELAY, abs=2e-3)
        car.now += PERIOD


def test_a_board_without_time_has_the_stamps_of_its_reads_themselves():
    """The same objects, however late a read is; and nothing of a clock in /diagnostics."""
    car = Car(earlier=lambda *_: pytest.fail('it has no time'))
    for index in range(10 * LEAST_POINTS):
        stamp = object()
        car.link.receiver.take(arduino.encode(arduino.Ticks(1)), stamp,
                               100.0 + index * PERIOD + index % 3 / 100)
        assert car.got.pop()[1] is stamp
    assert car.values() == {}
