"""What the campaign does to the bridge and to what it stands on: each row passes sound records and
finds what is wrong with doctored ones."""
import pytest

from campaign.check_bus import answered
from campaign.check_interference import (Connection, check_frozen_line, check_master, check_network,
                                         check_standstill, check_unread, opened_anew, registered)
from campaign.check_motor import Speed
from campaign.packets import HEARTBEAT, SPEED, STEERING, Packet
from campaign.records import Intervals, stretches

NEVER = Intervals()
STOPPED = Intervals([(5.0, 7.0)])


def beat(t):
    return Packet(t, HEARTBEAT, b'')


def speed(t, value):
    return Packet(t, SPEED, value.to_bytes(2, 'little', signed=True))


def driven(t, value, commanded):
    return Speed(t, value, commanded, True, t + 0.1, 0)


def steering(t, value):
    return Packet(t, STEERING, value.to_bytes(2, 'little'))


class TestStandstill:
    """From 5.0 to 7.0 s."""

    @staticmethod
    def violations(*came, driving=(), steered=(), before=(beat(4.995),)):
        """Of each of the two rows."""
        rows = check_standstill(STOPPED, list(before + came), list(driving), list(steered), NEVER)
        assert [row.tries for row in rows] == [1, 1]
        return [[words for _t, words in row.violations] for row in rows]

    def test_speed_0_first(self):
        assert self.violations(speed(7.01, 0), beat(7.01)) == [[], []]

    @pytest.mark.parametrize('came', [[beat(7.01), speed(7.01, 0)], [speed(7.01, 300)], []])
    def test_something_else_first(self, came):
        assert [len(found) for found in self.violations(*came)] == [1, 0]

    @pytest.mark.parametrize('came, number', [
        ([beat(7.01), speed(7.01, 0)], 0), ([beat(7.01), beat(7.01), speed(7.01, 0)], 1),
        ([speed(7.01, 300)], 1)])
    def test_stopped_in_the_middle_of_a_beat(self, came, number):
        first, _old = self.violations(*came, before=(beat(4.99),))
        assert len(first) == number

    @pytest.mark.parametrize('commanded, numbers', [(4.98, [0, 0]), (4.9, [1, 1]), (5.1, [1, 1])])
    def test_stopped_as_a_speed_was_handed_over(self, commanded, numbers):
        found = self.violations(speed(7.01, 300), speed(7.011, 0),
                                driving=[driven(7.01, 300, commanded), driven(7.011, 0, None)])
        assert [len(each) for each in found] == numbers

    def test_a_second_speed_of_before(self):
        first, old = self.violations(
            speed(7.01, 300), speed(7.011, 0), speed(7.012, 301), driving=[
                driven(7.01, 300, 4.98), driven(7.011, 0, None), driven(7.012, 301, 4.98)])
        assert first == [] and len(old) == 1 and 'SPEED 301' in old[0]

    @pytest.mark.parametrize('commanded, number', [(4.98, 0), (4.9, 1), (6.0, 1)])
    def test_stopped_as_steering_was_handed_over(self, commanded, number):
        first, _old = self.violations(steering(7.01, 1500), speed(7.011, 0),
                                      steered=[(4.98, 1400), (commanded, 1500)])
        assert len(first) == number

    @pytest.mark.parametrize('commanded', [4.9, 6.0])
    def test_an_old_command(self, commanded):
        _first, old = self.violations(speed(7.01, 0), driving=[
            driven(7.05, 300, commanded), driven(8.0, 301, 7.99)])
        assert len(old) == 1 and 'SPEED 300' in old[0]

    def test_while_the_port_is_closed_nothing_is_judged(self):
        first, _old = check_standstill(STOPPED, [beat(7.3)], [], [], Intervals([(6.0, 7.2)]))
        assert first.tries == 0


class TestFrozenLine:
    """The line freezes at 5.0 s; the latest steering that came was written at 4.955 s, and 1 ms
    later three heartbeats of before had come as well. Heartbeats are written each 10 ms."""

    WRITTEN = sorted([beat(index / 100) for index in range(300, 900)]
                     + [steering(4.455, 7), steering(4.955, 8)])
    CAME = [steering(4.456, 7), beat(4.956), steering(4.956, 8)] + [beat(4.97)] * 3

    def violations(self, *came, filled=(5.006,)):
        row = check_frozen_line(STOPPED, list(filled), self.WRITTEN, self.CAME + list(came), NEVER)
        assert row.tries == 1
        return row.violations

    def test_speed_0_first(self):
        assert not self.violations(speed(7.0001, 0), beat(7.0002))

    def test_behind_what_was_written_before_the_line_was_full(self):
        """At 4.99, 5.0 and 5.01 s: what is stamped up to 10 ms later may have left before."""
        assert not self.violations(*[beat(7.0001)] * 3, speed(7.0002, 0))
        assert self.violations(*[beat(7.0001)] * 4, speed(7.0002, 0))

    def test_where_the_campaign_needed_long_to_fill_it(self):
        assert not self.violations(*[beat(7.0001)] * 10, speed(7.0002, 0), filled=[5.076])
        assert self.violations(*[beat(7.0001)] * 11, speed(7.0002, 0), filled=[5.076])

    def test_never(self):
        assert self.violations(*[beat(7.0 + index / 100) for index in range(1, 50)],
                               speed(7.5, 0))


class TestUnread:
    NEVER = dict.fromkeys(('bus', 'arduino', 'mcu'), NEVER)
    DATA = {'bus': [t / 2 for t in range(100)], 'mcu': [t / 10 for t in range(500)]}

    def violations(self, data, excused=NEVER, anew=()):
        return check_unread(Intervals([(5.0, 45.0)]), 9, data, excused, list(anew)).violations

    def test_goes_on(self):
        assert not self.violations(self.DATA)

    def test_a_link_that_died(self):
        data = dict(self.DATA, mcu=[t for t in self.DATA['mcu'] if t < 20.0])
        (_t, what), = self.violations(data)
        assert 'mcu' in what

    def test_one_that_never_had_data(self):
        assert len(self.violations({'arduino': []})) == 1

    def test_a_port_that_was_not_there(self):
        data = dict(self.DATA, mcu=[t for t in self.DATA['mcu'] if not 20.0 < t < 30.0])
        assert not self.violations(data, dict(self.NEVER, mcu=Intervals([(20.0, 29.0)])))

    def test_a_link_that_only_begins_again_and_again(self):
        anew = [Connection(t, 'mcu', '') for t in (4.0, 20.0, 46.0)]
        assert [t for t, _what in self.violations(self.DATA, anew=anew)] == [20.0]


class TestNetwork:
    EVENTS = [{'t': 10.0, 'ev': 'frozen', 'link': 'network'},
              {'t': 14.0, 'ev': 'thawed', 'link': 'network'},
              {'t': 20.0, 'ev': 'vanished', 'link': 'network'}]

    def rows(self, beats, speeds=()):
        return check_network(self.EVENTS, [beat(t) for t in beats], list(speeds), 60.0)

    def test_returns(self):
        old, back = self.rows([9.0, 15.0, 20.05, 21.5], [driven(9.0, 300, 8.99)])
        assert back.tries == 2 and not back.violations and not old.violations

    def test_stays_away(self):
        _old, back = self.rows([9.0, 15.0, 20.05])
        assert len(back.violations) == 1

    def test_old_commands(self):
        old, _back = self.rows([], [driven(14.01, 300, 11.0)])
        assert len(old.violations) == 1


class TestOpenedAnew:
    def anew(self, *opened, cuts=()):
        absent = {link: Intervals([(t, t + 0.3) for t, cut in cuts if cut == link])
                  for link in ('bus', 'mcu')}
        return [(one.t, one.link) for one in opened_anew(absent, [
            Connection(t, link, '') for t, link in opened])]

    def test_the_first_ones(self):
        assert self.anew((1.0, 'bus'), (1.1, 'mcu')) == []

    def test_behind_a_cut(self):
        assert self.anew((1.0, 'bus'), (5.0, 'bus'), cuts=[(4.0, 'bus')]) == []

    def test_behind_a_cut_after_which_its_first_frame_still_came(self):
        assert self.anew((4.01, 'bus'), (5.0, 'bus'), cuts=[(4.0, 'bus')]) == []

    def test_without_one(self):
        assert self.anew((1.0, 'bus'), (5.0, 'bus')) == [(5.0, 'bus')]
        assert self.anew((1.0, 'bus'), (5.0, 'bus'), cuts=[(4.0, 'mcu')]) == [(5.0, 'bus')]

    def test_twice_behind_one_cut(self):
        assert self.anew((1.0, 'bus'), (5.0, 'bus'), (6.0, 'bus'), cuts=[(4.0, 'bus')]) == [
            (6.0, 'bus')]


class TestMaster:
    EVENTS = [{'t': 10.0, 'ev': 'master ended'}, {'t': 11.0, 'ev': 'master started'},
              {'t': 15.0, 'ev': 'registered'}]

    def test_back(self):
        back, ports = check_master(self.EVENTS, [])
        assert back.tries == 1 and not back.violations and not ports.violations

    def test_late(self):
        events = self.EVENTS[:2] + [{'t': 22.0, 'ev': 'registered'}]
        assert len(check_master(events, [])[0].violations) == 1

    def test_never(self):
        assert len(check_master(self.EVENTS[:2], [])[0].violations) == 1

    def test_a_port_opened_anew(self):
        anew = [Connection(t, 'bus', 'connection 2') for t in (9.0, 12.0, 16.0)]
        assert [t for t, _what in check_master(self.EVENTS, anew)[1].violations] == [12.0]

    def test_what_a_master_knows_of_a_node(self):
        state = [[['/imu', ['/a', '/b']]], [['/speed', ['/b']]], [['/lift', ['/a']]]]
        assert registered(state, {'bus': 1}, '/a') == {
            ('publishes', '/imu'), ('offers', '/lift'), ('parameter', 'bus')}


class TestCallsMeanwhile:
    TIMEOUTS = {'lift': 0.5}

    def row(self, **more):
        call = dict({'kind': 'lift', 't0': 5.0, 't1': 5.1, 'success': True, 'message': ''}, **more)
        return answered([call], self.TIMEOUTS, Intervals([(10.0, 12.0)]),
                        Intervals([(20.0, 22.0)]))

    def test_while_the_bridge_was_stopped(self):
        assert not self.row(t0=9.9, t1=12.5).violations
        assert len(self.row(t0=9.9, t1=14.5).violations) == 1
        assert len(self.row(t0=5.0, t1=7.5).violations) == 1

    def test_without_a_master(self):
        assert not self.row(t0=20.5, t1=20.6, exception='no service').violations
        assert len(self.row(t0=15.5, t1=15.6, exception='no service').violations) == 1


def test_stretches():
    events = [{'t': 1.0, 'ev': 'stopped'}, {'t': 2.0, 'ev': 'continued'},
              {'t': 3.0, 'ev': 'stopped', 'link': 'bus'}, {'t': 4.0, 'ev': 'stopped'}]
    assert stretches(events, 'stopped', 'continued', 9.0).pairs == [(1.0, 2.0), (4.0, 9.0)]
    assert stretches(events, 'stopped', 'continued', 9.0, 'bus').pairs == [(3.0, 9.0)]
