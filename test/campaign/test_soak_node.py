"""Each check passes sound records and finds what is wrong with doctored ones."""
import pytest

from campaign.check_node import cause_of, check_level, check_log, check_returns, log_lines


def level(memory):
    usage = [{'t': float(t), 'memory': memory(t), 'threads': 20, 'files': 90}
             for t in range(100)]
    return [row.violations for row in check_level(usage, 0.0, 33.0, 100.0)]


def test_level():
    assert level(lambda t: 40.0 + (t < 10) * t) == [[], [], []]


def test_growing():
    assert len(level(lambda t: 40.0 + t)[0]) == 1


def test_what_ports_take_as_they_come_and_go_is_no_growth():
    usage = [{'t': float(t), 'memory': 40.0, 'threads': 20,
              'files': 94 if t in (40, 41) or t > 66 else 86} for t in range(100)]
    assert not any(row.violations for row in check_level(usage, 0.0, 33.0, 100.0))


LOG = """\
[rosout][WARNING] 2026-11-21 01:12:04,470: mcu: /tmp/x/mcu: there is no such device (and 15 more like it)
[rosout][WARNING] 2026-11-21 01:12:05,172: bus: checksum: the checksum does not match: a502
[rosout][WARNING] 2026-11-21 01:12:%s,974: bus: checksum: the checksum does not match: a5f200
[rosout][WARNING] 2026-11-21 01:12:05,172: mcu: checksum: CRC does not match: 02
[rosout][WARNING] 2026-11-21 01:12:05,172: arduino says: IMU ready
[rosout][WARNING] 2026-11-21 01:12:05,173: arduino says: IMU ready
"""  # noqa: E501


def seconds_of(text):
    return float(text[17:].replace(',', '.'))


def test_log_with_time_in_between():
    row, faults = check_log(log_lines(LOG % 15, seconds_of))
    assert row.violations == [] and faults.violations == [] and row.tries == 4


def test_log_too_often():
    assert len(check_log(log_lines(LOG % 12, seconds_of))[0].violations) == 1


def test_log_with_a_fault_of_the_bridge():
    text = '[rosout][ERROR] 2026-11-21 01:12:04,470: mcu: Traceback (most recent call last):'
    assert len(check_log(log_lines(text, seconds_of))[1].violations) == 1


@pytest.mark.parametrize('one, other', [
    ('bus: checksum: it does not match: a5', 'bus: checksum: it does not match: a7 (and 3 more '
     'like it)'),
    ('bus: no reply to "lift up 3 mm" within 0.5 s', 'bus: no reply to "lift down 4 mm" within '
     '0.5 s'),
    ('arduino: speed 3 refused: the port is closed', 'arduino: speed 700 refused: the port is '
     'closed')])
def test_the_same_cause(one, other):
    assert cause_of(one) == cause_of(other)


@pytest.mark.parametrize('one, other', [
    (f'mcu: /{"folder/" * 12}mcu: there is no such device', f'mcu: /{"folder/" * 12}mcu: open'),
    ('bus: checksum: x', 'mcu: checksum: x'), ('bus: checksum: x', 'bus: framing: x')])
def test_another_cause(one, other):
    assert cause_of(one) != cause_of(other)


class TestReturns:
    def test_in_time(self):
        assert check_returns('bus', [(1.0, 9.0)], [0.5, 2.0]).violations == []

    def test_too_late(self):
        assert len(check_returns('bus', [(1.0, 9.0)], [0.5, 2.6]).violations) == 1

    def test_never(self):
        assert len(check_returns('bus', [(1.0, 9.0)], [0.5]).violations) == 1

    def test_gone_again_before_anybody_could_tell(self):
        assert check_returns('bus', [(1.0, 2.0)], []).tries == 0
