"""Each check passes sound records and finds what is wrong with doctored ones."""
from serial_communication.tools.soak.align import Sent
from serial_communication.tools.soak.check_frames import check_lost_frames, check_published
from serial_communication.tools.soak.records import Intervals


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


def lost(received, counted, resets=()):
    return check_lost_frames(received, Intervals(resets), counted).violations


class TestLostFrames:
    def test_counted(self):
        assert lost([(1, 0, 1, 0), (2, 0, 2, 1), (3, 0, 5, 4)], 2) == []

    def test_not_counted(self):
        assert len(lost([(1, 0, 1, 0), (2, 0, 2, 1), (3, 0, 5, 4)], 0)) == 1

    def test_the_board_sent_more(self):
        assert len(lost([(1, 0, 1, 0), (2, 0, 7, 1)], 0)) == 1

    def test_a_restart_is_a_gap(self):
        assert lost([(1, 0, 10, 9), (2, 0, 11, 0)], 246, resets=[(1.2, 1.5)]) == []

    def test_a_port_that_went(self):
        assert lost([(1, 0, 10, 9), (2, 1, 17, 16)], 0) == []

    def test_a_frame_of_noise(self):
        assert lost([(1, 0, 10, 9), (2, 0, -1, 12), (3, 0, 11, 10)], 2 + 253) == []
