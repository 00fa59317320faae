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
