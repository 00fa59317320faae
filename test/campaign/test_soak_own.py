"""Commands of one's own, as they reached the board, sound and doctored."""
from campaign.check_own import check_own_commands
from campaign.packets import OWN_COMMAND, Packet
from campaign.records import Intervals


def came(t, value):
    return Packet(t, OWN_COMMAND, value.to_bytes(2, 'big'))


def told(t, value):
    return {'t': t, 'topic': 'winch', 'value': value}


def violations(packets, commands, absent=(), unclear=()):
    row = check_own_commands(packets, commands, Intervals(absent), Intervals(unclear))
    assert row.tries == len(packets)
    return [what.partition(', ')[2] for _t, what in row.violations]


def test_each_commanded_and_sent_once():
    assert violations([came(1.01, 7), came(2.01, 8), came(9.01, 7)],
                      [told(1.0, 7), told(2.0, 8), told(9.0, 7)]) == []


def test_one_that_is_refused_does_not_come():
    assert violations([came(1.01, 7)], [told(1.0, 7), told(1.1, 8)]) == []


def test_one_that_nobody_commanded():
    assert violations([came(1.01, 8)], [told(1.0, 7)]) == ['which nobody commanded']
    assert violations([came(0.9, 7)], [told(1.0, 7)]) == ['which nobody commanded']


def test_one_that_its_row_does_not_allow():
    assert violations([came(1.01, 0)], [told(1.0, 0)]) == ['which nobody commanded']


def test_one_that_comes_twice():
    assert violations([came(1.01, 7), came(1.02, 7)], [told(1.0, 7)]) == ['a second time']


def test_one_that_was_kept():
    assert violations([came(2.5, 7)], [told(1.0, 7)]) == ['commanded 1.50 s before']
    assert violations([came(2.5, 7)], [told(1.0, 7)], unclear=[(1.0, 3.0)]) == []


def test_one_of_before_the_port_went():
    assert violations([came(1.5, 7)], [told(1.0, 7)], absent=[(1.2, 1.4)]) == [
        'commanded before the port went']


def test_one_that_the_line_still_passed_on_as_it_was_cut():
    assert violations([came(1.21, 7)], [told(1.19, 7)], absent=[(1.2, 1.4)]) == []
