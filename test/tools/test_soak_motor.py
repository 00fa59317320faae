"""Each row passes sound records and finds what is wrong with doctored ones."""
from serial_communication.tools.soak.check_motor import check_motor, prepare
from serial_communication.tools.soak.records import Intervals

END = 100.0


def speed(t, value):
    return {'t': t, 'ev': 'rx', 'type': 4, 'data': value.to_bytes(2, 'little', signed=True).hex()}


def told(t, value):
    return {'t': t, 'topic': 'speed', 'value': value}


CALIBRATION = {'topic': 'calibrate', 't0': 4.9, 't1': 4.95, 'error': ''}


def motor(journal, commands, unplugged=(), bridge=(), stalls=()):
    journal = sorted([{'t': 0.0, 'ev': 'port', 'open': True}] + journal,
                     key=lambda event: event['t'])
    reconnect, calibration, zero, commanded, _ran_on, made = check_motor(prepare(
        journal, commands, list(unplugged), Intervals(bridge), [], Intervals(stalls), 0.5, END))
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
    rows = check_motor(prepare(journal, [told(1.99, 300)], [], Intervals(), [], Intervals(), 0.5,
                               END))
    assert [len(row.violations) for row in rows] == [0] * 6
    assert rows[4].tries == 1 and rows[4].worst == 'for 2.5 s' and not rows[4].judged
