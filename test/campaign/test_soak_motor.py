"""Each row passes sound records and finds what is wrong with doctored ones."""
from campaign.check_motor import check_motor, prepare
from campaign.records import Intervals

END = 100.0


def speed(t, value):
    return {'t': t, 'ev': 'rx', 'type': 4, 'data': value.to_bytes(2, 'little', signed=True).hex()}


def told(t, value):
    return {'t': t, 'topic': 'speed', 'value': value}


CALIBRATION = {'topic': 'calibrate', 't0': 4.9, 't1': 4.95, 'error': ''}


def rows_of(journal, commands, absent=(), bridge=(), stalls=(), doubtful=()):
    journal = sorted([{'t': 0.0, 'ev': 'port', 'open': True}] + journal,
                     key=lambda event: event['t'])
    return dict(zip(('reconnect', 'calibration', 'zero', 'commanded', 'rules', 'stands', 'invented',
                     'made'), check_motor(prepare(
                         journal, commands, Intervals(absent), Intervals(bridge), [],
                         Intervals(stalls), Intervals(doubtful), 0.5, END))))


def motor(*arguments, **more):
    rows = rows_of(*arguments, **more)
    made = rows.pop('made')
    return {name: row.violations for name, row in rows.items()}, made.tries


def turns(t, value):
    return {'t': t, 'ev': 'motor', 'on': bool(value), 'speed': value, 'why': ''}


class TestMotor:
    def test_driven_and_stopped(self):
        found, _made = motor([speed(1.0, 300), speed(1.505, 0)], [told(0.99, 300)])
        assert not any(found.values())

    def test_never_stopped(self):
        found, _made = motor([speed(1.0, 300)], [told(0.99, 300)])
        assert len(found['zero']) == 1

    def test_stopped_late(self):
        found, _made = motor([speed(1.0, 300), speed(1.56, 0)], [told(0.99, 300)])
        assert len(found['zero']) == 1

    def test_stopped_late_as_the_whole_machine_stood_still(self):
        found, _made = motor([speed(1.0, 300), speed(1.56, 0)], [told(0.99, 300)],
                             stalls=[(1.45, 1.55)])
        assert found['zero'] == []

    def test_stopped_too_early(self):
        found, _made = motor([speed(1.0, 300), speed(1.2, 0)], [told(0.99, 300)])
        assert len(found['commanded']) == 1

    def test_stopped_by_command(self):
        found, _made = motor([speed(1.0, 300), speed(1.2, 0)], [told(0.99, 300), told(1.19, 0)])
        assert not any(found.values())

    def test_not_commanded(self):
        found, _made = motor([speed(1.0, 300), speed(1.5, 0)], [told(0.99, 301)])
        assert len(found['commanded']) == 1

    def test_a_line_that_thaws(self):
        """What was in the cable comes then; and SPEED 0 again, of a drop that was under way."""
        journal = [speed(6.62, 300), speed(6.621, 0), speed(6.622, 301), speed(6.64, 0)]
        commands = [told(4.99, 300), told(6.5, 301)]
        found, _made = motor(journal, commands, doubtful=[(5.0, 6.62)])
        assert not any(found.values())
        found, _made = motor(journal, [told(5.2, 300), told(6.5, 301)], doubtful=[(5.0, 6.62)])
        assert [name for name, violations in found.items() if violations] == ['reconnect']
        found, _made = motor(journal, commands, doubtful=[(5.0, 6.4)])
        assert found['commanded']

    def test_twice(self):
        found, _made = motor([speed(1.0, 300), speed(1.1, 300), speed(1.6, 0)], [told(0.99, 300)])
        assert len(found['commanded']) == 1

    def test_saturated(self):
        found, _made = motor([speed(1.0, -1000), speed(1.5, 0)], [told(0.99, -20000)])
        assert not any(found.values())

    def test_commanded_before_a_reconnect(self):
        port = [{'t': 1.1, 'ev': 'port', 'open': False}, {'t': 1.3, 'ev': 'port', 'open': True}]
        driving = port + [speed(1.5, 300), speed(2.0, 0)]
        found, _made = motor(driving, [told(1.0, 300)], [(1.1, 1.3)])
        assert len(found['reconnect']) == 1
        found, _made = motor(driving, [told(1.45, 300)], [(1.1, 1.3)])
        assert not found['reconnect']

    def test_the_line_still_passes_on_what_came_as_it_was_cut(self):
        found, _made = motor([speed(1.11, 300), speed(1.61, 0)], [told(1.09, 300)], [(1.1, 1.3)])
        assert not any(found.values())

    def test_kept_for_long(self):
        found, _made = motor([speed(3.0, 300), speed(3.5, 0)], [told(1.0, 300)])
        assert len(found['reconnect']) == 1

    def test_reached_a_board_that_calibrates(self):
        journal = [{'t': 5.0, 'ev': 'calibrate', 'on': True},
                   {'t': 6.0, 'ev': 'rx-lost', 'why': 'calibrating', 'data': '030421020000'},
                   {'t': 8.0, 'ev': 'calibrate', 'on': False, 'kept': '0404210300'}]
        found, _made = motor(journal, [told(5.9, 0x321), CALIBRATION])
        assert len(found['calibration']) == 1

    def test_read_at_once_with_the_call_for_the_calibration(self):
        calibrate = [{'t': 5.0, 'ev': 'calibrate', 'on': True}]
        commands = [told(4.9, 0x321), CALIBRATION]
        found, _made = motor([speed(5.0, 0x321)] + calibrate, commands)
        assert found['calibration'] == []
        found, _made = motor(calibrate + [
            {'t': 5.0, 'ev': 'rx-lost', 'why': 'calibrating', 'data': '0404210300'}], commands)
        assert len(found['calibration']) == 1

    def test_commanded_while_the_bridge_said_that_it_calibrates(self):
        found, _made = motor([speed(7.0, 300), speed(7.5, 0)], [told(6.9, 300), CALIBRATION],
                             bridge=[(4.95, 8.0)])
        assert len(found['calibration']) == 1

    def test_made_by_damage(self):
        journal = [{'t': 1.0, 'ev': 'rx-fault', 'faults': ['rx-flip'], 'came': '0404210300',
                    'became': '0404210100'}, speed(1.0, 0x121), speed(1.5, 0)]
        found, made = motor(journal, [told(0.99, 0x321)])
        assert not any(found.values()) and made == 1


class TestStands:
    """The motor itself, whatever came of the packets on the way."""

    def test_soon_enough(self):
        row = rows_of([speed(2.0, 300), turns(2.0, 300), speed(2.5, 0), turns(2.5, 0)],
                      [told(1.99, 300)])['stands']
        assert row.tries == 1 and row.violations == [] and row.worst == '510 ms'

    def test_a_speed_0_that_damage_took_and_no_other_came(self):
        lost = {'t': 2.5, 'ev': 'rx', 'raw': '020b400204010100', 'cause': 'framing', 'error': ''}
        journal = [speed(2.0, 300), turns(2.0, 300), lost, turns(5.0, 0)]
        rows = rows_of(journal, [told(1.99, 300)])
        assert [name for name, row in rows.items() if row.violations] == ['stands']

    def test_a_speed_0_that_damage_took_and_that_was_repeated(self):
        lost = {'t': 2.5, 'ev': 'rx', 'raw': '020b400204010100', 'cause': 'framing', 'error': ''}
        journal = [speed(2.0, 300), turns(2.0, 300), lost, speed(2.55, 0), turns(2.55, 0)]
        assert not any(row.violations for row in rows_of(journal, [told(1.99, 300)]).values())

    def test_of_commands_that_go_on(self):
        journal = [event for t in range(2, 9) for event in (
            speed(t / 2, 300 + t), turns(t / 2, 300 + t))]
        commands = [told(t / 2 - 0.01, 300 + t) for t in range(2, 9)]
        rows = rows_of(journal + [speed(4.5, 0), turns(4.5, 0)], commands)
        assert not any(row.violations for row in rows.values())

    def test_what_the_board_took_in_one_read_did_not_turn_it(self):
        """Behind a line that stood still, say."""
        journal = [speed(2.0, 300), turns(2.0, 300), speed(2.5, 0), turns(2.5, 0),
                   speed(9.0, 301), turns(9.0, 301), speed(9.0, 302), turns(9.0, 302),
                   speed(9.0, 0), turns(9.0, 0)]
        assert not rows_of(journal, [told(1.99, 300)])['stands'].violations
        assert rows_of(journal[:-1] + [turns(9.5, 0)], [
            told(1.99, 300), told(8.0, 301), told(8.1, 302)])['stands'].violations

    def test_until_the_end(self):
        journal = [speed(END - 2, 300), turns(END - 2, 300)]
        assert rows_of(journal, [told(END - 2.01, 300)])['stands'].violations

    def test_a_speed_that_damage_made_is_told_apart(self):
        journal = [{'t': 2.0, 'ev': 'rx-fault', 'faults': ['rx-flip'], 'came': '0404210300',
                    'became': '0404210100'}, speed(2.0, 0x121), turns(2.0, 0x121), turns(5.0, 0)]
        rows = rows_of(journal, [])
        assert rows['stands'].violations == [] and rows['invented'].tries == 1

    def test_what_a_board_that_stood_still_reads_at_once_turns_nothing(self):
        journal = [speed(1.0, 300), turns(1.0, 300), turns(1.04, 0),
                   {'t': 1.01, 'ev': 'fault', 'kind': 'stall', 'seconds': 1.2},
                   speed(2.21, 301), speed(2.21, 302), speed(2.21, 0),
                   turns(2.21, 301), turns(2.21, 302), turns(2.21, 0)]
        commands = [told(0.99, 300), told(1.05, 301), told(1.06, 302)]
        assert rows_of(journal, commands)['stands'].violations == []
        journal[-1] = turns(2.9, 0)
        assert rows_of(journal, commands)['stands'].violations == []
        journal[-1] = turns(3.1, 0)
        assert len(rows_of(journal, commands)['stands'].violations) == 1


class TestZerosByTheRules:
    """What the bridge sends by itself."""

    def test_repeated_for_a_second(self):
        journal = [speed(2.0, 300)] + [speed(2.5 + index / 20, 0) for index in range(21)]
        assert not rows_of(journal, [told(1.99, 300)])['rules'].violations

    def test_repeated_for_longer(self):
        journal = [speed(2.0, 300)] + [speed(2.5 + index / 20, 0) for index in range(60)]
        assert rows_of(journal, [told(1.99, 300)])['rules'].violations

    # That of the bridge's start, which the rules of the others have nothing to do with.
    START = [speed(3.0, 0), {'t': 3.001, 'ev': 'rx', 'type': 11, 'data': ''}]

    def found(self, journal, *arguments, **more):
        rules = rows_of(self.START + journal, *arguments, **more)['rules']
        return [t for t, _what in rules.violations]

    def test_as_the_bridge_starts(self):
        assert not self.found([], [])
        assert not self.found([speed(3.0 + index / 20, 0) for index in range(1, 21)], [])

    def test_the_first_one_behind_a_heartbeat(self):
        journal = [{'t': 3.0, 'ev': 'rx', 'type': 11, 'data': ''}, speed(5.0, 0)]
        assert [t for t, _what in rows_of(journal, [])['rules'].violations] == [5.0]

    def test_at_an_opening(self):
        port = [{'t': 5.0, 'ev': 'port', 'open': False}, {'t': 6.0, 'ev': 'port', 'open': True}]
        assert not self.found(port + [speed(6.1, 0)], [])

    def test_after_a_standstill(self):
        assert not self.found([speed(8.0, 0)], [], doubtful=[(6.0, 7.9)])

    def test_as_the_board_takes_in_what_came_while_it_read_nothing(self):
        stall = [{'t': 6.0, 'ev': 'fault', 'kind': 'stall', 'seconds': 1.9}]
        assert not self.found(stall + [speed(8.0, 0)], [])

    def test_commanded(self):
        assert not self.found([speed(8.0, 0)], [told(7.99, 0)])

    def test_before_a_calibration(self):
        assert not self.found([speed(4.97, 0)], [CALIBRATION])

    def test_as_the_board_has_calibrated_and_reads_what_came_on_the_way_to_it(self):
        calibration = [{'t': 5.0, 'ev': 'calibrate', 'on': True},
                       {'t': 8.0, 'ev': 'calibrate', 'on': False, 'kept': '0204010100'}]
        assert not self.found(calibration + [speed(8.0, 0)], [CALIBRATION])
        assert self.found(calibration + [speed(9.0, 0)], [CALIBRATION]) == [9.0]

    def test_after_a_speed(self):
        assert not self.found([speed(8.0, 300), speed(8.5, 0)], [told(7.99, 300)])

    def test_out_of_the_blue(self):
        assert self.found([speed(8.0, 0)], []) == [8.0]

    def test_between_commands_that_go_on(self):
        """One that is repeated although another speed has been accepted."""
        journal = [speed(2.0, 300), speed(2.1, 0), speed(2.12, 301), speed(2.15, 0)]
        commands = [told(1.99, 300), told(2.09, 0), told(2.11, 301)]
        assert not rows_of(journal[:3] + [speed(2.62, 0)], commands)['commanded'].violations
        late = [told(1.99, 300), told(1.995, 0), told(2.11, 301)]
        assert rows_of(journal, late)['commanded'].violations
