"""Faults that exclude each other never overlap, however long a campaign is."""
import pytest

from campaign.cli import main
from campaign.schedule import IN_TURN, LEAST, QUIET, cycles


@pytest.mark.parametrize('duration', [LEAST, 57, 59.9, 60, 61, 90, 119.9, 120, 179, 1800, 1e6])
@pytest.mark.parametrize('row', sorted(IN_TURN))
def test_one_is_over_before_the_next_one_and_the_end_is_quiet(duration, row):
    number, cycle = cycles(duration)
    assert number * cycle == pytest.approx(duration)
    stretches = [(turn.share * cycle, turn.share * cycle + turn.seconds) for turn in IN_TURN[row]]
    for (_start, over), (start, _over) in zip(stretches, stretches[1:]):
        assert over < start
    assert stretches[-1][1] <= cycle - QUIET + 1e-9


@pytest.mark.parametrize('text', [f'{LEAST - 0.1}', '20', '-1', 'nan', '1e7'])
def test_a_duration_that_does_not_hold_them_is_refused(text, capsys):
    with pytest.raises(SystemExit) as ended:
        main(['--duration', text])
    assert ended.value.code == 2
    assert f'may be {LEAST:g} to 1000000' in capsys.readouterr().err
