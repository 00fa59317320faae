"""Each check passes sound records and finds what is wrong with doctored ones."""
from serial_communication.tools.soak.check_arduino import (
    check_heartbeat, check_motor, closed_times, packets_of)
from serial_communication.tools.soak.records import Intervals

END = 100.0


def beats(*times):
    return [{'t': t, 'ev': 'rx', 'type': 11, 'data': ''} for t in times]


def steadily(start, end, period=0.01):
    return beats(*[start + index * period for index in range(int((end - start) / period))])


def heartbeat(journal, written=()):
    journal = sorted([{'t': 0.0, 'ev': 'port', 'open': True}] + journal,
                     key=lambda event: event['t'])
    gaps, _own, _machine, late, line = check_heartbeat(journal, [], list(written), END)
    return (gaps, late, line) if written else (gaps, late)


class TestHeartbeat:
    def test_steady(self):
        gaps, apart = heartbeat(steadily(1, 5))
        assert gaps.violations == [] and gaps.tries == 399 and apart.tries == 0
        assert gaps.worst.endswith('max 10.0 ms')

    def test_a_gap(self):
        gaps, _apart = heartbeat(steadily(1, 2) + steadily(2.03, 3))
        assert len(gaps.violations) == 1 and '40.0 ms' in gaps.violations[0][1]

    def test_a_gap_of_29_ms_is_none(self):
        assert heartbeat(beats(1, 1.029, 1.04))[0].violations == []

    def test_one_that_the_board_damaged_itself_has_come(self):
        damaged = [{'t': 2.01, 'ev': 'rx-fault', 'faults': ['rx-flip'], 'came': '020b00',
                    'became': '024b00'}]
        assert heartbeat(steadily(1, 2) + damaged + steadily(2.03, 3))[0].violations == []

    def test_while_the_board_reads_nothing(self):
        stall = [{'t': 2.0, 'ev': 'fault', 'kind': 'stall', 'seconds': 0.5}]
        assert heartbeat(steadily(1, 2) + stall + steadily(2.5, 3))[0].violations == []

    def test_after_the_board_reads_again(self):
        stall = [{'t': 2.0, 'ev': 'fault', 'kind': 'stall', 'seconds': 0.5}]
        gaps, _apart = heartbeat(steadily(1, 2) + stall + steadily(2.56, 3) + steadily(3.1, 4))
        assert len(gaps.violations) == 1

    def test_while_the_board_restarts(self):
        lost = [{'t': 2.0 + index / 100, 'ev': 'rx-lost', 'data': '020b00', 'why': 'reset'}
                for index in range(50)]
        assert heartbeat(steadily(1, 2) + lost + steadily(2.5, 3))[0].violations == []

    def test_while_the_board_calibrates(self):
        on = [{'t': 2.0, 'ev': 'calibrate', 'on': True},
              {'t': 3.0, 'ev': 'calibrate', 'on': False, 'kept': ''}]
        assert heartbeat(steadily(1, 2) + on + steadily(3.01, 4))[0].violations == []

    def test_while_the_port_is_closed(self):
        port = [{'t': 2.0, 'ev': 'port', 'open': False}, {'t': 3.0, 'ev': 'port', 'open': True}]
        assert heartbeat(steadily(1, 2) + port + steadily(3.4, 4))[0].violations == []

    def test_the_last_one_before_the_port_went(self):
        port = [{'t': 2.05, 'ev': 'port', 'open': False}, {'t': 3.0, 'ev': 'port', 'open': True}]
        assert len(heartbeat(steadily(1, 2) + port + steadily(3.4, 4))[0].violations) == 1

    def test_while_the_simulator_was_late_is_shown_apart(self):
        late = [{'t': 2.039, 'ev': 'late', 'by': 0.03}]
        gaps, apart = heartbeat(steadily(1, 2) + late + steadily(2.04, 3))
        assert gaps.violations == [] and apart.tries == 1 and '50.0 ms' in apart.worst

    def test_late_at_another_time_excuses_nothing(self):
        late = [{'t': 1.5, 'ev': 'late', 'by': 0.02}]
        assert len(heartbeat(steadily(1, 2) + late + steadily(2.04, 3))[0].violations) == 1

    def test_while_the_whole_machine_stood_still_is_shown_apart(self):
        found = standing_still(steadily(1, 2) + steadily(2.04, 3), {'t': 2.005, 'late': 0.025})
        assert found == (0, 1)

    def test_what_a_stall_of_the_machine_does_not_explain(self):
        found = standing_still(steadily(1, 2) + steadily(2.08, 3), {'t': 2.005, 'late': 0.025})
        assert found == (1, 0)


def standing_still(journal, stall):
    """How many gaps are violations, and how many are put down to the machine."""
    gaps, _own, machine, _late, _line = check_heartbeat(
        [{'t': 0.0, 'ev': 'port', 'open': True}] + journal, [stall], [], END)
    return len(gaps.violations), machine.tries


WRITTEN = [index / 100 for index in range(100, 310)]


class TestLine:
    """The pseudo terminals that stand for it were late."""

    def test_written_in_time_and_late_at_the_board(self):
        gaps, _late, line = heartbeat(steadily(1, 2) + steadily(2.05, 3), written=WRITTEN)
        assert gaps.violations == [] and line.tries == 1 and line.worst == '60.0 ms'

    def test_written_late(self):
        written = [t for t in WRITTEN if not 1.995 < t < 2.045]
        gaps, _late, line = heartbeat(steadily(1, 2) + steadily(2.05, 3), written=written)
        assert len(gaps.violations) == 1 and line.tries == 0

    def test_not_written(self):
        """What serial_msg does not tell excuses nothing."""
        gaps, _late, line = heartbeat(steadily(1, 2) + steadily(2.05, 3), written=[0.5])
        assert len(gaps.violations) == 1 and line.tries == 0


def speed(t, value):
    return {'t': t, 'ev': 'rx', 'type': 4, 'data': value.to_bytes(2, 'little', signed=True).hex()}


def told(t, value):
    return {'t': t, 'topic': 'speed', 'value': value}


CALIBRATION = {'topic': 'calibrate', 't0': 4.9, 't1': 4.95, 'error': ''}


def motor(journal, commands, unplugged=(), bridge=(), stalls=()):
    journal = sorted([{'t': 0.0, 'ev': 'port', 'open': True}] + journal,
                     key=lambda event: event['t'])
    reconnect, calibration, zero, commanded, _ran_on, made = check_motor(
        journal, commands, list(unplugged), Intervals(bridge), [], Intervals(stalls), 0.5, END)
    return {name: row.violations for name, row in (
        ('reconnect', reconnect), ('calibration', calibration), ('zero', zero),
        ('commanded', commanded))}, made.tries


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

    def test_twice(self):
        found, _made = motor([speed(1.0, 300), speed(1.1, 300), speed(1.6, 0)], [told(0.99, 300)])
        assert len(found['commanded']) == 1

    def test_saturated(self):
        found, _made = motor([speed(1.0, -1000), speed(1.5, 0)], [told(0.99, -20000)])
        assert not any(found.values())

    def test_commanded_before_a_reconnect(self):
        port = [{'t': 1.1, 'ev': 'port', 'open': False}, {'t': 1.3, 'ev': 'port', 'open': True}]
        found, _made = motor(port + [speed(1.5, 300), speed(2.0, 0)], [told(1.0, 300)], [1.1])
        assert len(found['reconnect']) == 1
        found, _made = motor(port + [speed(1.5, 300), speed(2.0, 0)], [told(1.45, 300)], [1.1])
        assert not found['reconnect']

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


def test_a_speed_0_that_damage_took():
    journal = [{'t': 1.0, 'ev': 'port', 'open': True}, speed(2.0, 300),
               {'t': 2.0, 'ev': 'motor', 'on': True, 'speed': 300, 'why': ''},
               {'t': 2.5, 'ev': 'rx', 'raw': '020b400204010100', 'cause': 'framing', 'error': ''},
               {'t': 5.0, 'ev': 'motor', 'on': False, 'speed': 0, 'why': ''}]
    rows = check_motor(journal, [told(1.99, 300)], [], Intervals(), [], Intervals(), 0.5,
                       END)
    assert [len(row.violations) for row in rows] == [0] * 6
    assert rows[4].tries == 1 and rows[4].worst == 'for 2.5 s' and not rows[4].judged


def test_packets_that_stand_behind_the_rest_of_another():
    came, _made = packets_of([{'t': 1.0, 'ev': 'rx', 'raw': '0c09020b00', 'cause': 'framing',
                               'error': ''}])
    assert [packet.type for packet in came] == [11]


def test_packets_joined_by_a_lost_end():
    """Damage took the end of SPEED -141; its rest and the heartbeat behind it decode to another."""
    journal = [{'t': 1.0, 'ev': 'rx-fault', 'faults': ['rx-lose'], 'came': '040473ff00',
                'became': '0404'},
               {'t': 1.001, 'ev': 'rx', 'type': 4, 'data': '020b'}]
    came, made = packets_of(journal)
    assert [(packet.type, packet.data.hex()) for packet in came] == [(4, '73ff'), (11, '')]
    assert [(packet.type, packet.data.hex()) for packet in made] == [(4, '020b')]


def test_packets_joined_by_a_lost_end_that_are_no_packet():
    journal = [{'t': 1.0, 'ev': 'rx-fault', 'faults': ['rx-lose'], 'came': '040473ff00',
                'became': '09'},
               {'t': 1.001, 'ev': 'rx', 'raw': '09020b00', 'cause': 'framing'},
               {'t': 1.01, 'ev': 'rx', 'type': 11, 'data': ''}]
    came, made = packets_of(journal)
    assert [(packet.t, packet.type) for packet in came] == [(1.0, 4), (1.001, 11), (1.01, 11)]
    assert made == []


def test_closed_times():
    journal = [{'t': 1.0, 'ev': 'port', 'open': True}, {'t': 2.0, 'ev': 'port', 'open': False},
               {'t': 3.0, 'ev': 'port', 'open': True}]
    assert closed_times(journal, END).pairs == [(0.0, 1.0), (2.0, 3.0)]


def test_intervals():
    found = Intervals([(3, 4), (1, 2), (1.5, 2.5)])
    assert found.pairs == [(1, 2.5), (3, 4)] and found.seconds() == 2.5
    assert found.holds(2.2) and not found.holds(2.7) and found.touches(2.6, 3.1)
    assert not found.touches(2.6, 2.9) and not Intervals().holds(1)
