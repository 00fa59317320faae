"""Programs as background jobs of a terminal that stops jobs which write to it (`stty tostop`)."""
from pathlib import Path

import pytest
from terminal import Terminal

SCRIPTS = Path(__file__).resolve().parents[2] / 'scripts'
_JOB = 'stty tostop; set -m; trap "kill %1" TERM; "$@" & wait -f %1'


@pytest.mark.parametrize('name, arguments, says', [
    ('serial_communication_node', [], 'Unable to register with master'),
    ('simulator', ['mcu', '--port', '/dev/no-such-device'], 'no such device'),
    ('panel', ['--port', '0'], 'panel: http://'),
    ('wire', ['listen', 'mcu', '/dev/no-such-device'], 'no such device')])
def test_a_program_that_serves_a_port_is_not_stopped_by_its_output(name, arguments, says):
    terminal = Terminal(['/bin/bash', '-c', _JOB, 'bash', str(SCRIPTS / name), *arguments],
                        ROS_MASTER_URI='http://127.0.0.1:9')
    try:
        terminal.until(lambda: says in terminal.text(), 'its first line')
    finally:
        terminal.close()
