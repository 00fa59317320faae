"""The frames that were lost, sound records and doctored ones."""
import random

from serial_communication.boards.mcu import wire as mcu
from campaign.check_lost import Heard, Told, check_lost_frames, heard_of


def frame(seq):
    return 0x10, seq % 256, b'%10d' % seq


def heard(*numbers, connection='connection 1', boot=1):
    return [Heard(float(n), connection, frame(n), n, boot) for n in numbers]


def violations(frames, told):
    row, = check_lost_frames(frames, told)
    return [what for _t, what in row.violations]


def statuses(frames, unseen, lost_before, every=7, wrong=0, wrong_from=None):
    """Made by a bridge that counts as it should, or differently from one frame on."""
    made, lost = [], lost_before
    for index, one in enumerate(frames):
        if index and frames[index - 1].connection == one.connection \
                and frames[index - 1].frame != one.frame:
            lost += (one.frame[1] - frames[index - 1].frame[1] - 1) % 256
        if index == wrong_from:
            lost += wrong
        if index % every == 0:
            made.append(Told(one.t + 0.3, unseen + index + 1, lost))
    return made


def recorded(seed):
    """Some hundred frames with gaps, doubles, and a port that flaps."""
    chance, frames, n = random.Random(seed), [], 1000
    for connection in range(1, 30):
        for _ in range(chance.randrange(2, 30)):
            n += chance.choice((1, 1, 1, 1, 1, 2, 2, 5))
            frames += heard(n, connection='connection %d' % connection) * chance.choice(
                (1, 1, 1, 1, 2))
        n += chance.randrange(1, 12)
    return frames


def test_a_bridge_that_counts_as_it_should():
    for seed in range(5):
        frames = recorded(seed)
        assert violations(frames, statuses(frames, 1234, 56)) == []


def test_a_bridge_that_counts_one_more_or_less_once():
    for wrong in (1, -1, 8):
        frames = recorded(1)
        assert violations(frames, statuses(frames, 1234, 56, wrong=wrong,
                                           wrong_from=len(frames) // 2))


def test_a_bridge_that_counts_what_went_with_a_port():
    frames = recorded(2)
    counted = [one._replace(connection='connection 1') for one in frames]
    assert violations(frames, statuses(counted, 0, 0))


def test_statuses_of_a_time_before_the_first_frame_that_is_known():
    frames = recorded(3)
    early = [Told(0.0, 5, 0), Told(1.0, 20, 3)]
    assert violations(frames, early + statuses(frames, 100, 9)) == []


def test_a_status_whose_two_counts_were_read_around_a_frame():
    frames = heard(1, 2, 3, 7, 8, 9, 10)
    told = [Told(2.0, 2, 0), Told(3.0, 3, 3), Told(4.0, 4, 0), Told(7.0, 7, 3)]
    assert violations(frames, told) == []


def test_the_board_sent_more():
    frames = heard(1, 2, 3)
    frames[2] = frames[2]._replace(n=9)
    assert violations(frames, [Told(3.0, 3, 0)]) == [
        'SEQ says 0 lost, the board sent 6 in between']


def test_a_restart_is_a_gap_and_more_than_256_lost_are_less():
    frames = heard(1, 2) + [Heard(3.0, 'connection 1', frame(0), 3, 2)]
    assert violations(frames, [Told(3.0, 3, 253)]) == []
    frames = heard(1, 2, 300)
    assert violations(frames, [Told(3.0, 3, 41)]) == []


def test_a_frame_of_noise():
    frames = heard(1, 2) + [Heard(2.5, 'connection 1', (0x99, 6, b''))] + heard(3)
    assert violations(frames, [Told(3.0, 4, 3 + 252)]) == []


def test_what_the_journal_knows_of_a_frame():
    def tx(t, n, seq):
        return {'t': t, 'ev': 'tx', 'n': n, 'type': 16, 'seq': seq,
                'raw': mcu.encode_raw(16, seq, b'ten bytes.').hex()}
    journal = [{'t': 0.0, 'ev': 'boot'}, tx(1.0, 1, 0), tx(2.0, 2, 1), {'t': 2.5, 'ev': 'boot'},
               tx(3.0, 3, 0), tx(9.0, 4, 1)]
    taken = [(1.5, 'connection 1', (16, 0, b'ten bytes.')),
             (4.0, 'connection 1', (16, 0, b'ten bytes.')),
             (5.0, 'connection 2', (16, 1, b'ten bytes.')),
             (6.0, 'connection 2', (16, 1, b'other data'))]
    assert [(one.n, one.boot) for one in heard_of(journal, taken)] == [
        (1, 1), (3, 2), (2, 1), (-1, 0)]
