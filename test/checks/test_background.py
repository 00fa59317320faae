"""Programs as background jobs of a terminal that stops jobs which write to it (`stty tostop`)."""
import os
import shlex
import subprocess
from pathlib import Path

import pytest
from waiting import PATIENCE, until

SCRIPTS = Path(__file__).resolve().parents[2] / 'scripts'


@pytest.mark.parametrize('name, arguments, says', [
    ('serial_communication_node', [], 'Unable to register with master'),
    ('simulator', ['mcu', '--port', '/dev/no-such-device'], 'no such device'),
    ('panel', ['--port', '0'], 'panel: http://'),
    ('wire', ['listen', 'mcu', '/dev/no-such-device'], 'no such device')])
def test_a_program_that_serves_a_port_is_not_stopped_by_its_output(name, arguments, says, tmp_path):
    job = ' '.join(map(shlex.quote, [str(SCRIPTS / name), *arguments]))
    output = tmp_path / 'output'
    output.touch()
    job = f'stty tostop; set -m; trap "kill %1" HUP TERM; {job} & wait -f %1'
    with subprocess.Popen(     # `script` makes the terminal
            ['script', '-qefc', job, str(output)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            env={**os.environ, 'SHELL': '/bin/bash', 'ROS_MASTER_URI': 'http://127.0.0.1:9'},
            ) as terminal:
        try:
            until(lambda: says in output.read_text(errors='replace'), says)
        finally:
            terminal.terminate()
            terminal.wait(PATIENCE)
