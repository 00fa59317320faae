"""The rate of a port: that of the parameters, else that of the board's description.

The programs open real ttys, which show the rate that was set.
"""
import os
import pty
import re
import subprocess
import sys
import termios

import pytest
from serial_communication.boards import description
from serial_communication.ros.parameter import baud
from waiting import PATIENCE
from wire_lines import ROOT

PAGE = open(os.path.join(ROOT, 'doc', 'developing.md'), encoding='utf-8').read()
RATES = [    # the board, the parameters, the rate
    ('arduino', 'arduino: {port: x}', 115200),
    ('arduino', 'arduino: {baud: 57600}', 57600),
    ('wind_sensor', 'boards: [wind_sensor]', 4800),
    ('wind_sensor', 'boards: [wind_sensor]\nwind: {baud: 9600}', 9600)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder on Python's path with the board of doc/developing.md."""
    for name, text in re.findall(r'<!-- file: (wind_sensor/\S+) -->\n```\w+\n(.*?)^```$', PAGE,
                                 re.MULTILINE | re.DOTALL):
        (tmp_path / 'wind_sensor').mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [str(tmp_path), os.environ.get('PYTHONPATH', '')]))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in [name for name in sys.modules if name.split('.')[0] == 'wind_sensor']:
        del sys.modules[name]


@pytest.mark.parametrize('program', ['wire', 'simulator'])
@pytest.mark.parametrize('board, parameters, rate', RATES)
def test_a_program_opens_the_port_at_the_rate_of_the_parameters(
        folder, program, board, parameters, rate):
    (folder / 'config.yaml').write_text(parameters)
    near, far = pty.openpty()
    path = os.ttyname(far)
    arguments = ['listen', board, path] if program == 'wire' else [board, '--port', path]
    process = subprocess.Popen([sys.executable, f'{ROOT}/scripts/{program}', *arguments,
                                '--config', str(folder / 'config.yaml')],
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert any(f'{path}: open' in line for line in process.stdout)
        assert termios.tcgetattr(near)[5] == getattr(termios, f'B{rate}')
    finally:
        process.kill()
        process.communicate()
        os.close(near)
        os.close(far)


def test_the_bridges_parameter_has_the_rate_of_the_description(folder):
    for name, rate in ('arduino', 115200), ('wind_sensor', 4800):
        assert baud(description(name)).default == rate
    assert "'baud': baud(DESCRIPTION)" in (folder / 'wind_sensor' / 'ros.py').read_text()


@pytest.mark.parametrize('given', ['fast', '0', '115200.0', 'true'])
def test_a_rate_that_the_bridge_refuses_is_refused_by_every_program(folder, given):
    config = folder / 'config.yaml'
    config.write_text(f'arduino: {{baud: {given}}}')
    for arguments in (['wire', 'listen', 'arduino', '/dev/null', '--config', config],
                      ['simulator', 'arduino', '--port', '/dev/null', '--config', config],
                      ['ports', '--config', config, '/dev/null']):
        done = subprocess.run([sys.executable, f'{ROOT}/scripts/{arguments[0]}',
                               *map(str, arguments[1:])], stdout=subprocess.PIPE,
                              stderr=subprocess.PIPE, text=True, timeout=PATIENCE)
        assert done.returncode == 2 and "arduino/baud is " in done.stderr
        assert 'may be a whole number from 50 to 4000000 (baud)' in done.stderr
