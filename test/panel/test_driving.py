"""The dead man's switch, without a clock and without a browser."""
import pytest
from serial_communication.tools.panel.driving import (MAX_AGE, SILENCE, CommandRefused,
                                                      DeadManSwitch, Hold)


class Car:
    """Counts how often it was stopped."""

    def __init__(self):
        self.stops = []
        self.switch = DeadManSwitch(self.stops.append)

    def command(self, page, number, seen, now, moves=('car',)):
        self.switch.command(Hold(page, number, moves, now), seen)


@pytest.fixture
def car():
    return Car()


def test_silence_stops_once_and_ends_the_hold(car):
    car.command('one', 1, 100, 100)
    car.switch.check(100 + SILENCE * 0.99)
    assert not car.stops
    car.switch.check(100 + SILENCE)
    car.switch.check(101)
    assert car.stops == [('car',)]
    with pytest.raises(CommandRefused, match='let go and press again'):
        car.command('one', 1, 101, 101)
    car.command('one', 2, 101, 101)
    assert car.switch.hold and len(car.stops) == 1


def test_a_command_after_silence_stops_even_without_a_check_in_between(car):
    """As after the process was suspended."""
    car.command('one', 1, 100, 100)
    with pytest.raises(CommandRefused):
        car.command('one', 1, 104.9, 105)
    assert len(car.stops) == 1


@pytest.mark.parametrize('seen', [100 - MAX_AGE - 0.01, 95, 0, 100.5, float('nan'), float('inf')])
def test_a_delayed_command_does_not_drive_and_ends_its_hold(car, seen):
    with pytest.raises(CommandRefused, match='too slow'):
        car.command('one', 1, seen, 100)
    assert not car.switch.hold
    with pytest.raises(CommandRefused, match='let go'):
        car.command('one', 1, 100, 100)


def test_release_stops_once_and_that_of_an_older_hold_does_not(car):
    car.command('one', 2, 100, 100)
    car.switch.release('one', 1)
    assert car.switch.hold and not car.stops
    car.switch.release('one', 2)
    car.switch.release('one', 2)
    assert len(car.stops) == 1
    with pytest.raises(CommandRefused):
        car.command('one', 2, 100.01, 100.01)


def test_only_one_page_drives(car):
    car.command('one', 1, 100, 100)
    with pytest.raises(CommandRefused, match='another page drives'):
        car.command('other', 7, 100.05, 100.05)
    car.switch.release('other', 7)
    assert car.switch.hold.page == 'one' and not car.stops
    car.switch.release('one', 1)
    car.command('other', 8, 100.1, 100.1)
    assert car.switch.hold.page == 'other'


def test_a_page_that_is_closed_stops(car):
    car.command('one', 1, 100, 100)
    car.switch.forget('other')
    assert not car.stops
    car.switch.forget('one')
    assert len(car.stops) == 1 and not car.switch.hold


def test_a_new_press_or_another_motion_after_a_lost_release_stops_in_between(car):
    car.command('one', 1, 100, 100)
    car.command('one', 2, 100.1, 100.1)
    assert car.stops == [('car',)] and car.switch.hold.number == 2
    car.command('one', 2, 100.1, 100.1, ('base',))
    assert len(car.stops) == 2 and car.switch.hold.moves == ('base',)
