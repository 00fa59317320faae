"""Pairing what was published with what was sent."""
from campaign.align import Sent, align


def sent(*keys, may=()):
    return [Sent(float(index), key, index not in may) for index, key in enumerate(keys)]


def published(*keys, delay=0.0):
    return [(key[0] + delay if isinstance(key, tuple) else float(index) + delay,
             key[1] if isinstance(key, tuple) else key) for index, key in enumerate(keys)]


def test_all_in_order():
    found = align(sent(*'abcd'), published(*'abcd'))
    assert found == ([(0, 0), (1, 1), (2, 2), (3, 3)], [], [])


def test_nothing_at_all():
    assert align([], []) == ([], [], [])


def test_a_lost_one_is_found_where_it_was():
    found = align(sent(*'abcd'), published((0, 'a'), (2, 'c'), (3, 'd')))
    assert found.lost == [1] and found.extra == []


def test_what_may_be_lost_is_no_loss():
    found = align(sent(*'abcd', may=[1]), published((0, 'a'), (2, 'c'), (3, 'd')))
    assert found.lost == [] and found.extra == []


def test_a_doubled_one_is_extra():
    found = align(sent(*'abcd'), published((0, 'a'), (1, 'b'), (1, 'b'), (2, 'c'), (3, 'd')))
    assert len(found.extra) == 1 and found.lost == []


def test_an_invented_one_is_extra():
    found = align(sent(*'abcd'), published((0, 'a'), (1, 'x'), (1, 'b'), (2, 'c'), (3, 'd')))
    assert found.extra == [1] and found.lost == []


def test_two_that_changed_places():
    found = align(sent(*'abcd'), published((0.0, 'a'), (2.0, 'c'), (2.0, 'b'), (3.0, 'd')))
    assert len(found.lost) == 1 and len(found.extra) == 1


def test_one_that_may_be_lost_does_not_take_the_place_of_one_that_must_not():
    """Equal values: the one that was published is the second's."""
    found = align(sent('a', 'z', 'z', 'b', may=[1]), published((0, 'a'), (2, 'z'), (3, 'b')))
    assert found.lost == [] and found.extra == []


def test_published_before_it_was_sent_is_no_match():
    found = align(sent('a', 'b'), published((0, 'a'), (0.5, 'b')))
    assert found.lost == [1] and found.extra == [1]


def test_published_much_too_late_is_no_match():
    found = align(sent('a', 'b'), published((0, 'a'), (9.0, 'b')), late=3.0)
    assert found.lost == [1] and found.extra == [1]


def test_long_runs_of_equal_values():
    """A thousand equal values of which one was lost: one loss, in a moment."""
    keys = ['t'] * 1000
    times = [(index / 100, key) for index, key in enumerate(keys)]
    one = [Sent(t, key, index % 50 != 7) for index, (t, key) in enumerate(times)]
    del times[500]
    assert len(align(one, times).lost) <= 1
    assert align(one, times).extra == []


def test_many_losses_in_a_long_run():
    one = [Sent(index / 100, index, True) for index in range(20000)]
    times = [(index / 100, index) for index in range(20000) if index % 1000]
    found = align(one, times)
    assert found.lost == list(range(0, 20000, 1000)) and found.extra == []
