"""Stamps of other hosts' clocks: what is late, and who is never condemned for ever."""
import pytest

from serial_communication.links.lateness import Lateness

ANOTHER_CLOCK = 1.7e9      # s that the sender's clock is ahead of ours


@pytest.fixture
def late():
    """of(sent, arrived): whether a command of /driver was refused, and by how much."""
    lateness = Lateness(0.5)

    def of(sent, arrived, sender='/driver', connection=lateness):
        return lateness.of(sender, connection, sent + ANOTHER_CLOCK, arrived)
    return of


def test_commands_in_time_are_taken_whatever_the_clocks_say(late):
    assert not any(late(at, at + delay) for at, delay in
                   ((1.0, 0.03), (1.1, 0.01), (1.2, 0.4), (1.3, 0.02)))


def test_what_a_network_held_up_is_late_by_that(late):
    late(1.0, 1.01)
    assert late(2.0, 8.0) == pytest.approx(5.99, abs=0.01)
    assert late(7.9, 8.0) == 0.0


def test_a_queue_that_drains_slowly_is_late_to_its_end(late):
    """The commands of 20 s, delivered within 10 s: nothing of it is taken for the new normal."""
    late(0.0, 0.0)
    for number in range(1, 190):
        assert late(number * 0.1, 20.0 + number * 0.05)


def test_a_sender_that_restarts_begins_anew(late):
    late(100.0, 100.0)
    assert late(1.0, 101.0)
    assert late(1.1, 101.1, connection='another') == 0.0


def test_a_clock_that_is_set_back_is_believed_after_5_s(late):
    late(100.0, 100.0)
    refused = [bool(late(100.0 + tick / 10 - 60.0, 100.0 + tick / 10)) for tick in range(1, 100)]
    assert all(refused[:49]) and not any(refused[53:])


def test_one_stamp_of_the_future_condemns_nobody(late):
    late(1e6, 1.0)
    assert late(1.1, 1.1)
    assert [late(1.1 + tick / 10, 1.1 + tick / 10) for tick in range(70)][-1] == 0.0


def test_clocks_that_drift_apart_are_followed(late):
    for minute in range(0, 10000):
        assert late(minute * 60.0 * (1 - 2e-4), minute * 60.0) == 0.0


def test_senders_do_not_know_each_other(late):
    late(100.0, 100.0)
    assert late(1.0, 100.0, sender='/other') == 0.0
    assert late(100.1, 100.2) == 0.0


def test_no_stamp_and_no_limit_are_never_late():
    lateness = Lateness(0.5)
    lateness.of('/driver', None, 100.0, 100.0)
    assert lateness.of('/driver', None, 0.0, 200.0) == 0.0
    lateness = Lateness(0.0)
    lateness.of('/driver', None, 100.0, 100.0)
    assert lateness.of('/driver', None, 100.1, 200.0) == 0.0
