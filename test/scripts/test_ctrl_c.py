"""Ctrl-C ends the campaign and the bench, and all processes that they have started."""
import os
import subprocess
from pathlib import Path

import psutil
import pytest
from processes import Stage
from terminal import Terminal
from waiting import until

SCRIPTS = Path(__file__).resolve().parents[2] / 'scripts'


@pytest.mark.parametrize('name, arguments, says', [
    ('bench', ['--only', 'bus'], 'bus ...'), ('soak', [], 'starting')])
def test_ctrl_c_ends_the_program_and_its_processes(name, arguments, says, tmp_path):
    folder = tmp_path / 'a folder'
    folder.mkdir()
    if name == 'soak':
        arguments = ['--keep', str(folder / 'records')]
    terminal = Terminal(['/bin/bash', '-c', 'cd / && exec "$@"', 'bash', SCRIPTS / name,
                         *arguments], TMPDIR=str(folder))
    try:
        terminal.until(lambda: says in terminal.text(), 'it has started')
        assert processes_in(folder)
        terminal.press(b'\3')
        terminal.wait()
    finally:
        terminal.close()
    assert terminal.status == 130, terminal.text()
    assert terminal.text().rstrip().endswith('stopped') and 'Traceback' not in terminal.text()
    assert processes_in(folder) == []


def test_campaigns_on_broken_bridges_end_with_the_program_that_started_them(tmp_path):
    def mistakes():         # logs of nodes that its scenario starts, one after another
        return len(list(tmp_path.rglob('mistake_*.out')))

    program = subprocess.Popen([SCRIPTS / 'soak', '--broken', 'mistake_status_0'],
                               env=dict(os.environ, TMPDIR=str(tmp_path)),
                               stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        until(mistakes, 'its scenario runs')
    finally:
        program.kill()
        program.wait()
    until(lambda: not processes_in(tmp_path), 'all have ended')
    assert mistakes() < 4, 'the scenario went on'


def test_a_process_that_starts_during_ctrl_c_is_ended(tmp_path, monkeypatch):
    def interrupt(child):
        raise KeyboardInterrupt

    stage = Stage('', str(tmp_path))
    monkeypatch.setattr(stage, 'add', interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.busy(1)
    assert processes_in(tmp_path)
    stage.__exit__()
    assert processes_in(tmp_path) == []


def test_what_a_process_has_started_is_killed_with_it(tmp_path):
    stage = Stage('', str(tmp_path))
    child = stage.child('shell', ['bash', '-c', 'trap "" TERM; setsid sleep 1000 & sleep 1000'])
    stage.wait(lambda: processes_in(tmp_path) == ['bash', 'sleep', 'sleep'], 'it has started both')
    stage.end(child, grace=0.1)
    assert processes_in(tmp_path) == []


def processes_in(folder):
    """Return the names of the processes that run in this folder or below it, or with a path in it
    as an argument."""
    found = []
    for process in psutil.process_iter(['cwd', 'cmdline', 'name']):
        if any(text.startswith(str(folder))
               for text in (process.info['cwd'] or '', *(process.info['cmdline'] or ()))):
            found.append(process.info['name'])
    return found
