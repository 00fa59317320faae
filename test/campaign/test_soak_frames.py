"""Each check passes sound records and finds what is wrong with doctored ones."""
from campaign.align import Sent
from campaign.check_frames import check_published
from campaign.records import Intervals


def published(values, sent=None):
    sent = sent or [Sent(index / 10, index, True, 'ok', index) for index in range(10)]
    row, blind, _maybe = check_published('g', 's', {'topic': (sent, values)})
    return row, blind


class TestPublished:
    def test_all(self):
        row, _blind = published([(index / 10 + 0.001, index) for index in range(10)])
        assert row.violations == [] and row.tries == 10 and row.worst.startswith('1 ms')

    def test_one_lost(self):
        row, _blind = published([(index / 10, index) for index in range(10) if index != 4])
        assert len(row.violations) == 1 and 'frame 4 was not' in row.violations[0][1]

    def test_one_wrong(self):
        row, _blind = published([(index / 10, index if index != 4 else 44) for index in range(10)])
        assert len(row.violations) == 2

    def test_damage_that_nobody_can_see(self):
        sent = [Sent(0.0, 1, True, 'ok'), Sent(0.1, 2, False, 'blind'), Sent(0.2, 3, True, 'ok')]
        row, blind = published([(0.0, 1), (0.1, 2), (0.2, 3)], sent)
        assert row.violations == [] and blind == 1

    def test_what_waited_in_a_line_that_was_stopped_for_long(self):
        """The line held everything from 0.05 s to 5 s, so all of it came then."""
        sent = [Sent(index / 10, index, True, 'ok', index) for index in range(10)]
        came = [(0.0, 0, 0.0)] + [(5.0, index, 5.0) for index in range(1, 10)]
        row, _blind, _maybe = check_published('g', 's', {'topic': (sent, came)},
                                              Intervals([(0.05, 5.0)]))
        assert row.violations == []
        assert published(came, sent)[0].violations

    def test_what_waited_while_the_bridge_was_stopped_is_not_published(self):
        sent = [Sent(index / 10, index, False, 'ok', index) for index in range(40)]
        stopped = Intervals([(0.95, 3.0)])
        fresh = [(index / 10, index) for index in range(40) if not 9 < index < 31]
        row, _blind, _maybe = check_published('g', 's', {'topic': (sent, fresh)}, stopped=stopped)
        assert row.violations == []
        came = sorted(fresh + [(3.01, 15)])
        row, _blind, _maybe = check_published('g', 's', {'topic': (sent, came)}, stopped=stopped)
        assert len(row.violations) == 1 and 'frame 15 was published 1.51 s later' in \
            row.violations[0][1]
