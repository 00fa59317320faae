"""scripts/demo in a real terminal: its table at each size, and its end."""
from pathlib import Path

import pytest
from programs import free_master, processes_with
from terminal import Terminal

ROOT = Path(__file__).resolve().parents[2]
CTRL_C = b'\3'
LINKS = ('bus', 'arduino', 'mcu')


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


def is_table(rows):
    """Whether a screen shows the links and the car."""
    return all(any(row.startswith(name + ' ') for row in rows) for name in (*LINKS, 'car'))


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
    terminal.press(CTRL_C)
    terminal.wait()
    assert terminal.status == 0


def test_faults_are_counted_at_the_links(demo):
    terminal = demo('--faults', 'flip=0.3 cut=0.2')
    for name in LINKS:
        terminal.until(lambda name=name: any(
            row.startswith(name + ' ') and 'errors ' in row and 'errors 0' not in row
            for screen in terminal.screens() for row in screen), f'an invalid frame on {name}')
    terminal.press(CTRL_C)
    terminal.wait()
    assert terminal.status == 0


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
    terminal.wait()
    assert terminal.status == 0
    assert descendants(terminal) == []
    assert 'Traceback' not in terminal.text()
