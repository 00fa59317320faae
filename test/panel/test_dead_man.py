"""The dead man's switch, without a clock and without a browser."""
import pytest
from serial_communication.tools.panel.dead_man import FRESH, SILENCE, DeadMan, Refused


class Car:
    """Counts how often it was told to stop."""

    def __init__(self):
        self.stops = 0
        self.man = DeadMan(self.stop)

    def stop(self):
        self.stops += 1


@pytest.fixture
def car():
    return Car()


def test_drives_while_held(car):
    for step in range(10):
        now = 100 + step * 0.05
        car.man.command('one', 1, now - 0.03, now)
        car.man.check(now)
    assert car.man.hold and not car.stops


def test_silence_stops_once_and_what_comes_of_that_hold_later_does_not_drive(car):
    car.man.command('one', 1, 100, 100)
    car.man.check(100 + SILENCE * 0.99)
    assert not car.stops
    car.man.check(100 + SILENCE)
    car.man.check(101)
    assert car.stops == 1
    with pytest.raises(Refused, match='let go and press again'):
        car.man.command('one', 1, 101, 101)
    car.man.command('one', 2, 101, 101)
    assert car.man.hold and car.stops == 1


def test_silence_counts_also_where_nobody_has_looked_meanwhile(car):
    """The process was suspended, and finds the next command as it wakes."""
    car.man.command('one', 1, 100, 100)
    with pytest.raises(Refused):
        car.man.command('one', 1, 104.9, 105)
    assert car.stops == 1


@pytest.mark.parametrize('seen', [100 - FRESH - 0.01, 95, 0, 100.5, float('nan'), float('inf')])
def test_what_a_network_has_kept_back_does_not_drive(car, seen):
    with pytest.raises(Refused, match='too slow'):
        car.man.command('one', 1, seen, 100)
    assert not car.man.hold
    with pytest.raises(Refused, match='let go'):
        car.man.command('one', 1, 100, 100)


def test_a_connection_that_becomes_slow_stops(car):
    car.man.command('one', 1, 100, 100)
    with pytest.raises(Refused, match='too slow'):
        car.man.command('one', 1, 99.8, 100.15)
    assert car.stops == 1 and not car.man.hold


def test_release_stops_once(car):
    car.man.command('one', 1, 100, 100)
    car.man.release('one', 1)
    car.man.release('one', 1)
    assert car.stops == 1
    with pytest.raises(Refused):
        car.man.command('one', 1, 100.01, 100.01)


def test_a_release_that_overtakes_nothing(car):
    """The release of an older hold does not end a newer one."""
    car.man.command('one', 2, 100, 100)
    car.man.release('one', 1)
    assert car.man.hold and not car.stops


def test_one_browser_drives(car):
    car.man.command('one', 1, 100, 100)
    with pytest.raises(Refused, match='another browser'):
        car.man.command('other', 7, 100.05, 100.05)
    car.man.release('other', 7)
    assert car.man.hold.who == 'one' and not car.stops
    car.man.release('one', 1)
    car.man.command('other', 8, 100.1, 100.1)
    assert car.man.hold.who == 'other'


def test_a_browser_that_goes_stops(car):
    car.man.command('one', 1, 100, 100)
    car.man.forget('other')
    assert not car.stops
    car.man.forget('one')
    assert car.stops == 1 and not car.man.hold


def test_a_release_that_was_lost(car):
    """A new press of the same browser is a new hold; the car stops between them."""
    car.man.command('one', 1, 100, 100)
    car.man.command('one', 2, 100.1, 100.1)
    assert car.stops == 1 and car.man.hold.number == 2
