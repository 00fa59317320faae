"""Wrong arguments of scripts/demo, test and pictures are reported before any set-up."""
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / 'scripts'


def run(program, *arguments):
    return subprocess.run([str(SCRIPTS / program), *arguments], text=True, timeout=30, cwd='/',
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE)


@pytest.mark.parametrize('arguments, words', [
    (['--fast'], 'unknown argument: --fast'),
    (['20'], 'unknown argument: 20'),
    (['--duration'], '--duration needs a number of seconds'),
    (['--duration', 'long'], "--duration is 'long', must be a number of seconds above 0"),
    (['--duration', '-1'], "--duration is '-1'"),
    (['--duration=0'], "--duration is '0'"),
    (['--duration='], None),
    (['--ports'], '--ports needs LINK=PORT'),
    (['--ports', '--move'], '--ports needs LINK=PORT'),
    (['--ports', '/dev/ttyS0'], "'/dev/ttyS0' is not LINK=PORT: write bus=PORT"),
    (['--ports', 'lift=/dev/ttyS0'], "'lift=/dev/ttyS0' is not LINK=PORT"),
    (['--ports', 'bus='], "'bus=' names no port"),
    (['--ports', 'bus=/dev/a', 'bus=/dev/b'], 'the port of bus is given twice'),
    (['--ports', 'bus=/dev/ttyS0', '--avr'], '--avr and --ports exclude each other'),
    (['--move'], '--move goes with --ports'),
    (['--faults'], '--faults needs faults'),
    (['--faults', 'flap=1'], "there is no fault 'flap'"),
    (['--faults=flip=0.1 cut=2'], "fault 'cut': a probability is 0 to 1"),
    (['--faults', 'all', '--avr'], '--faults goes with the simulated boards'),
    (['--faults', 'all', '--ports', 'bus=/dev/ttyS0'], '--faults goes with the simulated boards'),
])
def test_wrong_arguments_of_demo_give_status_2_and_two_lines(arguments, words):
    done = run('demo', *arguments, *([] if words else ['--wrong']))
    assert done.returncode == 2
    assert (words or 'unknown argument: --wrong') in done.stderr
    assert done.stderr.startswith('demo: ') and len(done.stderr.splitlines()) == 2
    assert not done.stdout


@pytest.mark.parametrize('arguments, words', [
    (['everything'], 'unknown part: everything'), (['--fast'], 'unknown part: --fast'),
    (['ros/nothing'], 'no file test/ros/nothing.test')])
def test_wrong_arguments_of_test_give_status_2_and_two_lines(arguments, words):
    done = run('test', *arguments)
    assert done.returncode == 2
    assert words in done.stderr and len(done.stderr.splitlines()) == 2


def test_wrong_arguments_of_pictures_give_status_2_and_two_lines():
    done = run('pictures', '--fast')
    assert done.returncode == 2
    assert 'unknown argument: --fast' in done.stderr and len(done.stderr.splitlines()) == 2


@pytest.mark.parametrize('program', ['demo', 'test', 'pictures'])
@pytest.mark.parametrize('option', ['--help', '-h'])
def test_help_fits_100_columns(program, option):
    done = run(program, option)
    assert done.returncode == 0
    assert done.stdout.startswith('usage: scripts/' + program) and not done.stderr
    assert max(map(len, done.stdout.splitlines())) <= 100
