"""scripts/demo in a real terminal: its table at each size, and its end."""
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from programs import arguments_of, free_master, processes_with
from terminal import Terminal
from waiting import again_if_stalled
from witness import Witness

ROOT = Path(__file__).resolve().parents[2]
CTRL_C = b'\3'
LINKS = ('bus', 'arduino', 'mcu')
MOST = 3.0      # s until the demo has ended, on a machine that has time


@pytest.fixture(name='demo')
def fixture_demo():
    """A function that starts a demo with its own master."""
    started, uri = [], free_master()

    def start(*arguments, columns=80, rows=24):
        started.append(Terminal([ROOT / 'scripts' / 'demo', *arguments], columns, rows,
                                ROS_MASTER_URI=uri))
        started[-1].uri = uri
        return started[-1]
    yield start
    for terminal in started:
        terminal.close()
        assert descendants(terminal) == []


def descendants(terminal):
    """Return the processes of a demo that still run."""
    return processes_with(f'SERIAL_COMMUNICATION_DEMO={terminal.pid}')


def ends_in_time(terminal):
    """Wait for the end of a demo; return whether it came in time."""
    with Witness(work=0.02, period=0.1) as witness:
        took = terminal.wait()
    print(f'ended after {took:.2f} s, slowed down by {witness.slowdown:.2f}')
    return took < MOST * witness.slowdown


def is_table(rows):
    """Whether a screen shows the links and the car."""
    return all(any(row.startswith(name + ' ') for row in rows) for name in (*LINKS, 'car'))


def ignores_ctrl_c(pid):
    status = Path(f'/proc/{pid}/status').read_text()
    return int(status.split('SigIgn:')[1].split()[0], 16) & 1 << signal.SIGINT - 1


def test_links_and_calls_are_shown_at_every_size_and_hidden_topics_are_counted(demo):
    terminal = demo(columns=60, rows=15)
    for columns, rows in (60, 15), (200, 60):
        terminal.resize(columns, rows)
        seen = len(terminal.screens())
        screen = terminal.until(
            lambda: next((each for each in terminal.screens()[seen + 1:] if is_table(each)), None),
            f'a table at {columns} by {rows}')
        assert sum(max(1, -(-len(row) // columns)) for row in screen) <= rows, screen
        setup, = [row for row in screen if row.startswith('In another terminal:')]
        assert setup.split('  ', 1)[1].startswith(f'. {ROOT}/build/devel/setup.bash')
        assert f'ROS_MASTER_URI={terminal.uri}' in setup
        assert screen[-1].endswith('more lines') == (rows == 15), screen
    # During a calibration, refused after a stall, the bridge sends no speed, and none is shown.
    command = f'. {ROOT}/build/devel/setup.bash; rosservice call ' \
        '/serial_communication/calibrate_imu'
    again_if_stalled(lambda: subprocess.run(
        ['bash', '-c', command], timeout=60, stdout=subprocess.DEVNULL,
        env={**os.environ, 'ROS_MASTER_URI': terminal.uri}).returncode == 0)
    screen = terminal.until(lambda: next(
        (each for each in terminal.screens()
         if any(row.startswith('car     speed refused: calibrating') for row in each)), None),
        'the refused speed')
    assert not any('~speed' in row for row in screen)
    assert [arguments_of(pid) for pid in descendants(terminal) if ignores_ctrl_c(pid)] == []
    terminal.press(CTRL_C)
    assert ends_in_time(terminal) and terminal.status == 0


def test_faults_are_counted_at_the_links(demo):
    terminal = demo('--faults', 'flip=0.3 cut=0.2')
    for name in LINKS:
        terminal.until(lambda name=name: any(
            row.startswith(name + ' ') and 'errors ' in row and 'errors 0' not in row
            for screen in terminal.screens() for row in screen), f'an invalid frame on {name}')
    terminal.press(CTRL_C)
    assert ends_in_time(terminal) and terminal.status == 0


# The output just before Ctrl-C is pressed: roslaunch or the nodes have their own signal handlers
# then, or none yet, or wait for a master that has ended.
@pytest.mark.parametrize('moment', [
    'Launching', 'auto-starting new master', 'process[serial_communication-', 'mcu_board-'])
def test_ctrl_c_during_the_start_ends_every_process(demo, moment):
    terminal = demo()
    log = ROOT / 'build' / 'ros' / 'log' / f'demo_{terminal.pid}.log'
    terminal.until(lambda: 'Launching' in terminal.text(), 'it launches')
    if moment != 'Launching':
        terminal.until(lambda: log.exists() and moment in log.read_text(errors='replace'), moment)
    terminal.press(CTRL_C)
    assert ends_in_time(terminal)
    assert terminal.status == 0
    assert descendants(terminal) == []
    assert 'Traceback' not in terminal.text()


def test_a_roslaunch_that_hangs_is_killed_without_output_of_the_shell(demo):
    terminal = demo()
    terminal.until(lambda: any(is_table(each) for each in terminal.screens()), 'the table')
    roslaunch, = [pid for pid in descendants(terminal) if '--skip-log-check' in arguments_of(pid)]
    os.kill(roslaunch, signal.SIGSTOP)
    terminal.press(CTRL_C)
    assert ends_in_time(terminal) and terminal.status == 0
    assert 'Killed' not in terminal.text()


@pytest.mark.parametrize('delay', [0.05, 0.15, 0.25, 0.4])
def test_ctrl_c_during_the_set_up_ends_the_demo(demo, delay):
    terminal = demo()
    time.sleep(delay)       # no condition to wait for: any time is a valid case
    terminal.press(CTRL_C)
    assert ends_in_time(terminal)
    # On a busy machine bash may not have read the first line by then, and ends by the signal.
    assert terminal.status == 0 or (terminal.status == -signal.SIGINT
                                    and terminal.text().strip() in ('', '^C'))
