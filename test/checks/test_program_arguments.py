"""--help, wrong arguments and an early Ctrl-C of every program."""
import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / 'scripts'
PROGRAMS = sorted(path.name for path in SCRIPTS.iterdir()
                  if os.access(str(path), os.X_OK))
OF_ROS = 'monitor', 'panel', 'release', 'serial_communication_node'
WRONG = (
    ('avr_board', ()), ('avr_board', ('wheel',)), ('avr_board', ('bus', '--wrong')),
    ('avr_board', ('bus', '--link')), ('avr_board', ('--elf',)), ('bench', ('--wrong',)),
    ('monitor', ('--wrong',)), ('panel', ('--wrong',)), ('ports', ('--wrong',)),
    ('ports', ('--seconds', '-1')), ('ports', ('socket://x',)), ('release', ()),
    ('release', ('arduino',)), ('release', ('arduino', '--wrong', '--', 'true')),
    ('serial_communication_node', ('--wrong',)),
    ('serial_communication_node', ('/dev/ttyS0',)), ('serial_communication_node', (':=x',)),
    ('serial_communication_node', ('bus',)), ('simulator', ()),
    ('simulator', ('wheel',)), ('simulator', ('bus', '--wrong')), ('soak', ('--wrong',)),
    ('wire', ()), ('wire', ('wheel',)), ('wire', ('listen', 'wheel')),
)
# What a script of a checkout says, before any set-up.
SAYS = (
    ('demo', '--fast', 'unknown argument: --fast'), ('demo', '20', 'unknown argument: 20'),
    ('demo', '--duration', '--duration needs a number of seconds'),
    ('demo', '--duration long', "--duration is 'long', must be a number of seconds above 0"),
    ('demo', '--duration -1', "--duration is '-1'"), ('demo', '--duration=0', "--duration is '0'"),
    ('demo', '--duration= --wrong', 'unknown argument: --wrong'),
    ('demo', '--ports', '--ports needs LINK=PORT'),
    ('demo', '--ports --move', '--ports needs LINK=PORT'),
    ('demo', '--ports /dev/ttyS0', "'/dev/ttyS0' is not LINK=PORT: write bus=PORT"),
    ('demo', '--ports lift=/dev/ttyS0', "'lift=/dev/ttyS0' is not LINK=PORT"),
    ('demo', '--ports bus=', "'bus=' names no port"),
    ('demo', '--ports bus=/dev/a bus=/dev/b', 'the port of bus is given twice'),
    ('demo', '--ports bus=/dev/ttyS0 --avr', '--avr and --ports exclude each other'),
    ('demo', '--move', '--move goes with --ports'), ('demo', '--faults', '--faults needs faults'),
    ('demo', '--faults flap=1', "there is no fault 'flap'"),
    ('demo', '"--faults=flip=0.1 cut=2"', "fault 'cut': a probability is 0 to 1"),
    ('demo', '--faults all --avr', '--faults goes with the simulated boards'),
    ('demo', '--faults all --ports bus=/dev/ttyS0', '--faults goes with the simulated boards'),
    ('test', 'everything', 'unknown part: everything'),
    ('test', 'ros/nothing', 'no file test/ros/nothing.test'),
    ('pictures', '--fast', 'unknown argument: --fast'))


def run(name, *arguments, **environment):
    """Run a program without a master, in a folder that is not writable."""
    return subprocess.run([str(SCRIPTS / name), *arguments], text=True, timeout=60, cwd='/proc',
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE,
                          env={**os.environ, 'ROS_MASTER_URI': 'http://127.0.0.1:9', **environment})


@pytest.mark.parametrize('name', PROGRAMS)
@pytest.mark.parametrize('option', ['-h', '--help'])
def test_help_prints_the_usage(name, option, tmp_path):
    """Also where another python3, as of pyenv or conda, is first on the path."""
    (tmp_path / 'python3').write_text('#!/bin/sh\necho "the wrong python3 was run"\nexit 9\n')
    (tmp_path / 'python3').chmod(0o755)
    path = os.environ['PYTHONPATH'] if name in OF_ROS else ''
    done = run(name, option, PATH=f'{tmp_path}:{os.environ["PATH"]}', PYTHONPATH=path)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: ')
    assert name in done.stdout.split('\n', 1)[0]
    if name in ('demo', 'test', 'pictures'):
        assert max(map(len, done.stdout.splitlines())) <= 100


@pytest.mark.parametrize('name', ['avr_board', 'bench', 'demo', 'pictures', 'test'])
def test_help_installs_and_builds_nothing_and_touches_no_ros(name, tmp_path):
    checkout = tmp_path / 'checkout'
    for folder in 'scripts', 'test/bench', 'test/helpers', 'firmware':
        shutil.copytree(str(SCRIPTS.parent / folder), str(checkout / folder))
    missing = 'psutil', 'tabulate', 'tqdm', 'yaml', 'rosgraph', 'rospy', 'serial_communication'
    for module in missing:      # as if nothing of it were installed
        (checkout / 'test' / 'helpers' / f'{module}.py').write_text('raise ImportError(__name__)')
    done = subprocess.run([str(checkout / 'scripts' / name), '--help'], text=True, timeout=60,
                          env={'PATH': '/usr/bin:/bin'}, stdin=subprocess.DEVNULL,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: ')
    assert not (checkout / 'build' / 'devel').exists()


@pytest.mark.parametrize('name, arguments', WRONG, ids=lambda each: str(each))
def test_wrong_arguments_give_status_2(name, arguments):
    done = run(name, *arguments)
    assert (done.returncode, done.stdout) == (2, '')
    assert name in done.stderr and ('usage:' in done.stderr or '--help' in done.stderr)
    assert 'Traceback' not in done.stderr


@pytest.mark.parametrize('name, arguments, words', SAYS)
def test_wrong_arguments_of_a_script_are_two_lines_before_any_set_up(name, arguments, words):
    done = run(name, *shlex.split(arguments))
    assert done.returncode == 2 and words in done.stderr and not done.stdout
    assert done.stderr.startswith(name + ': ') and len(done.stderr.splitlines()) == 2
