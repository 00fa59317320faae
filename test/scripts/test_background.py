"""Programs as background jobs of a terminal that stops what writes to it (`stty tostop`)."""
from pathlib import Path

import pytest
from terminal import Terminal

SCRIPTS = Path(__file__).resolve().parents[2] / 'scripts'
_JOB = 'stty tostop; set -m; trap "kill %1" TERM; "$@" & wait -f %1'


@pytest.mark.parametrize('name, arguments, says', [
    ('serial_communication_node', [], 'waiting for the ROS master'),
    ('simulator', ['mcu', '--port', '/dev/no-such-device'], 'no such device'),
    ('panel', ['--port', '0'], 'panel: http://'),
    ('wire', ['listen', 'mcu', '/dev/no-such-device'], 'no such device')])
def test_a_line_to_the_terminal_stops_none_that_serves_a_port(name, arguments, says):
    terminal = Terminal(['/bin/bash', '-c', _JOB, 'bash', str(SCRIPTS / name), *arguments],
                        ROS_MASTER_URI='http://127.0.0.1:9')
    try:
        terminal.until(lambda: says in terminal.text(), 'its first line')
    finally:
        terminal.close()
