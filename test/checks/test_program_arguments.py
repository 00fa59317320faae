"""--help and wrong arguments of every program."""
import os
import shlex
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = {path.name: path for folder in ('scripts', 'test/bench', 'test/panel')
            for path in (ROOT / folder).iterdir() if path.is_file() and os.access(path, os.X_OK)}
OF_CHECKOUT = 'demo', 'pictures', 'test'
OF_ROS = 'monitor', 'moves', 'panel', 'release', 'serial_communication_node'
WRONG = '''
avr_board
avr_board wheel
bench --wrong
demo --fast
demo --duration long
monitor --wrong
moves
panel --wrong
pictures --fast
ports --wrong
ports --seconds -1
ports --config /no/such/file x
release
release arduino --wrong -- true
serial_communication_node --wrong
serial_communication_node :=x
simulator
simulator mcu --port x --faults "flip=0.1 flap=1"
simulator bus --port x --link y
simulator bus --port x --lift-speed 0
simulator bus --port nonsense://x
soak --wrong
test everything
test ros/nothing
wire
wire listen
wire listen mcu
wire listen mcu nonsense://x
wire listen mcu /dev/null --baud 0
wire play a
wire play a mcu b --rate 2
wire explain mcu 02 --dance
'''


def run(name, *arguments, **environment):
    """Run a program without a master, in a folder that is not writable."""
    return subprocess.run([str(PROGRAMS[name]), *arguments], text=True, timeout=60, cwd='/proc',
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE,
                          env={**os.environ, 'ROS_MASTER_URI': 'http://127.0.0.1:9', **environment})


@pytest.mark.parametrize('name', sorted(PROGRAMS))
@pytest.mark.parametrize('option', ['-h', '--help'])
def test_help_prints_the_usage(name, option, tmp_path):
    """Also where another python3, as of pyenv or conda, is first on the path."""
    (tmp_path / 'python3').write_text('#!/bin/sh\necho "the wrong python3 was run"\nexit 9\n')
    (tmp_path / 'python3').chmod(0o755)
    path = os.environ['PYTHONPATH'] if name in OF_ROS else ''
    done = run(name, option, PATH=f'{tmp_path}:{os.environ["PATH"]}', PYTHONPATH=path)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: ') and name in done.stdout.split('\n', 1)[0]
    assert name not in OF_CHECKOUT or max(map(len, done.stdout.splitlines())) <= 100


@pytest.mark.parametrize('line', WRONG.split('\n')[1:-1])
def test_wrong_arguments_give_status_2_and_no_traceback(line):
    name, *arguments = shlex.split(line)
    done = run(name, *arguments)
    assert (done.returncode, done.stdout) == (2, '') and done.stderr
    assert name in done.stderr.splitlines()[-1] and 'Traceback' not in done.stderr
