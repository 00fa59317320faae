"""What takes long: the judge with fresh seeds, all mutants searched anew, and the bench."""
import subprocess
from pathlib import Path

import judge
import pytest
from mutants import MUTANTS, broken_by

ROOT = Path(__file__).resolve().parents[2]
_MOST = 200     # seeds within which each mutant has to be found


def test_ten_minutes_of_fresh_seeds_break_no_promise():
    assert judge.main(['--hours', '0.167']) == 0


@pytest.mark.parametrize('name', MUTANTS)
def test_a_broken_promise_is_found_by_one_of_the_first_seeds(name):
    with broken_by(name):
        assert any(judge.run(seed).broken for seed in range(_MOST))


def test_the_bench_measures_all():
    done = subprocess.run(
        [str(ROOT / 'test' / 'bench' / 'bench'), '--short'], stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, done.stdout
