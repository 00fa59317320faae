"""scripts/demo ends by itself where it cannot go on, and leaves no process and no file."""
import contextlib
import os
import signal
import socket
import subprocess
from pathlib import Path

import pytest
from programs import arguments_of, free_master, processes_with
from waiting import PATIENCE, until

DEMO = Path(__file__).resolve().parents[2] / 'scripts' / 'demo'


@pytest.fixture(name='folder')
def fixture_folder(tmp_path):
    """The folder of temporary files of what a test starts; it must be empty at the end."""
    folder = tmp_path / 'temporary'
    folder.mkdir()
    yield folder
    assert list(folder.iterdir()) == []


@contextlib.contextmanager
def started(folder, command, uri, **environment):
    """Run a command, of which no process may be left at the end."""
    process = subprocess.Popen(
        [str(each) for each in command], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'TMPDIR': str(folder), 'ROS_MASTER_URI': uri, **environment})
    try:
        yield process
        until(lambda: running(folder) == [], 'no process is left')
    finally:
        for pid in running(folder):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.communicate()


def running(folder):
    """The processes that were started with this folder for temporary files."""
    return processes_with(f'TMPDIR={folder}')


@pytest.mark.parametrize('uri, why', [
    ('http://no-such-host.invalid:11311', 'the name no-such-host.invalid cannot be resolved'),
    ('lab', 'it is no address such as http://localhost:11311'),
    (None, 'no answer within 10 s')])
def test_a_master_that_cannot_be_used_is_named_with_the_mend(folder, uri, why):
    with socket.socket() as silent:      # it accepts connections and never answers
        silent.bind(('localhost', 0))
        silent.listen()
        uri = uri or f'http://localhost:{silent.getsockname()[1]}'
        with started(folder, [DEMO], uri) as demo:
            output, errors = demo.communicate(timeout=PATIENCE)
    assert demo.returncode == 1 and 'Launching' not in output
    assert errors == f'demo: no ROS master answers at {uri}: {why}. ' \
        'For a master of its own:  unset ROS_MASTER_URI\n'


def test_the_end_of_roslaunch_ends_the_demo_with_its_last_lines(folder):
    with started(folder, [DEMO], free_master()) as demo:
        log = DEMO.parents[1] / 'build' / 'ros' / 'log' / f'demo_{demo.pid}.log'
        until(lambda: log.exists() and 'process[serial_communication-' in log.read_text(),
              'roslaunch has output')
        roslaunch, = [pid for pid in running(folder) if '--skip-log-check' in arguments_of(pid)]
        os.kill(roslaunch, signal.SIGKILL)
        errors = demo.communicate(timeout=PATIENCE)[1]
    assert demo.returncode == 1
    assert 'process[serial_communication-' in errors
    assert errors.endswith('demo: roslaunch has ended; see its last output above.\n')


def test_a_reader_that_has_ended_ends_the_demo_without_a_word(folder):
    pipe = ['bash', '-o', 'pipefail', '-c', '"$0" | head -n 2', DEMO]
    with started(folder, pipe, free_master()) as demo:
        output, errors = demo.communicate(timeout=PATIENCE)
    assert (demo.returncode, errors) == (128 + signal.SIGPIPE, '')
    assert output.splitlines()[1].endswith('the bridge is there')
