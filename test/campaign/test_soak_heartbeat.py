"""Each check passes sound records and finds what is wrong with doctored ones."""
from campaign.check_heartbeat import check_heartbeat

END = 100.0


def beats(*times):
    return [{'t': t, 'ev': 'rx', 'type': 11, 'data': ''} for t in times]


def steadily(start, end, period=0.01):
    return beats(*[start + index * period for index in range(int((end - start) / period))])


def heartbeat(journal, written=()):
    journal = sorted([{'t': 0.0, 'ev': 'port', 'open': True}] + journal,
                     key=lambda event: event['t'])
    gaps, _own, _machine, late, line, _user = check_heartbeat(journal, [], list(written), END)
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
    gaps, _own, machine, _late, _line, _user = check_heartbeat(
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


def test_without_real_time_priority_a_gap_is_counted_and_no_violation():
    journal = [{'t': 0.0, 'ev': 'port', 'open': True}] + beats(1.0, 1.01, 1.06)
    for realtime in (True, False):
        rows = check_heartbeat(journal, [], [], END, realtime=realtime)
        assert len(rows[0].violations) == realtime
        assert (rows[-1].tries, rows[-1].judged) == (not realtime, False)
