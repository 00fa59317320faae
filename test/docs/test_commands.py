"""Runs every command of the pages, except those marked as needing a board.

A comment right before a block of commands tells how to run it:

    <!-- run: bridge -->       beside a bridge with simulated boards
    <!-- run: launch -->       each line starts a bridge, whose links all become OK
    <!-- run: background -->   all at the same time; then the bus link becomes OK
    <!-- run: play -->         all at the same time, the last after the bridge has opened, with
                               a recording drive.bag; then the arduino link becomes OK
    <!-- run: panel -->        a bridge, whose links become OK, and the page at its address
    <!-- run: avr -->          beside a bridge with emulated boards, their folder in $SIM_DIR
    <!-- run by: PART -->      by that part of scripts/test
    <!-- file: NAME -->        not a command: by test/ros/external_board_test.py
    <!-- needs a board -->     not run; likewise `needs a screen`, `a container`, `a network`,
                               `a workspace`
"""
import re
import sys
import urllib.request
from concurrent.futures import ThreadPoolExecutor

import pytest
from pages import PAGES, ROOT, blocks
from stage import Stage
from waiting import PATIENCE, again_if_stalled

sys.path.insert(0, str(ROOT / 'test' / 'firmware'))
from emulated_board import build_firmware  # noqa: E402

BLOCKS = [block for page in PAGES for block in blocks(page)]
PYTHON = [block for block in BLOCKS if block.language == 'python' and not block.mark]
BESIDE = PYTHON + [block for block in BLOCKS if block.mark == 'run: bridge']
LINKS = ('bus', 'arduino', 'mcu')
NODE = '/serial_communication'
NEEDS = ('board', 'screen', 'container', 'network', 'workspace')
RUN = ('bridge', 'launch', 'background', 'play', 'panel', 'avr')


def marked(mark):
    """Parametrize a test with the blocks of commands that have this mark."""
    return pytest.mark.parametrize('block', [
        block for block in BLOCKS if block.language == 'sh' and block.mark == mark],
        ids=lambda block: getattr(block, 'id', 'none'))


def lines(block):
    """Return the commands of a block with one command per line."""
    return [line.partition('  #')[0].strip() for line in block.text.splitlines() if line.strip()]


@pytest.fixture(scope='module')
def master(tmp_path_factory):
    with Stage(tmp_path_factory.mktemp('docs')).master() as stage:
        yield stage


@pytest.fixture(scope='module')
def bridge(tmp_path_factory):
    """A master, and a bridge with simulated boards."""
    with Stage(tmp_path_factory.mktemp('bridge')).master() as stage, stage.background([
            'roslaunch serial_communication bridge.launch sim:=true publish_tf:=true '
            f'sim_dir:={stage.folder}/sim']):
        stage.until(lambda: stage.links_are_ok(*LINKS), 'all links are OK')
        yield stage


@pytest.fixture(scope='module')
def beside(bridge):
    """The results of the blocks beside the bridge, by id. Three run at a time, since most only
    wait."""
    def run(block):
        if block.language == 'sh':
            return bridge.run_while_ok(block.text, *LINKS)
        program = bridge.folder / f'example_{block.line}.py'
        program.write_text(block.text)
        return bridge.run(f'/usr/bin/python3 {program}')

    with ThreadPoolExecutor(3) as pool:
        yield {block.id: pool.submit(run, block) for block in BESIDE}


def test_every_block_of_commands_has_a_valid_mark():
    parts = re.search(r'^parts=\(([^)]*)\)$', (ROOT / 'scripts' / 'test').read_text(), re.M)
    for block in BLOCKS:
        if block.language != 'sh':
            continue
        kind, _, part = block.mark.partition('run by: scripts/test ')
        assert block.mark in (
            *(f'needs a {each}' for each in NEEDS), *(f'run: {each}' for each in RUN)) or (
                not kind and part in parts.group(1).split()), f'{block.id}: {block.mark!r}'


@marked('run: bridge')
def test_a_block_beside_a_bridge_succeeds(block, beside):
    done = beside[block.id].result()
    assert done.returncode == 0, done.stdout


_LAUNCHED = set()     # lines that have run


@marked('run: launch')
def test_each_launched_bridge_becomes_ok(block, master):
    for line in lines(block):
        if 'sim:=avr' in line or line in _LAUNCHED:
            continue        # needs emulated boards, or has run for another page
        with master.background([f'{line} sim_dir:={master.folder}/launch']):
            # With faults on the lines, errors are expected.
            master.until(lambda: master.links_are_ok(*LINKS, or_warn='faults:=' in line),
                         'all links are OK')
        master.until(lambda: not master.node_answers(NODE), 'the bridge has ended')
        _LAUNCHED.add(line)


@marked('run: panel')
def test_the_panel_serves_its_page(block, master):
    line, = lines(block)
    with master.background([f'{line} sim_dir:={master.folder}/panel '
                            'panel_args:="--port 0"']):
        master.until(lambda: master.links_are_ok(*LINKS), 'all links are OK')
        master.until(lambda: 'panel: http://' in master.output(), 'the page has an address')
        address = re.search(r'panel: (\S+)', master.output()).group(1)
        with urllib.request.urlopen(address, timeout=PATIENCE) as page:
            assert b'<html' in page.read()


@marked('run: background')
def test_commands_in_the_background_make_a_link_ok(block, master):
    with master.background(lines(block)):
        master.until(lambda: master.links_are_ok('bus'), 'the link is OK')


@marked('run: play')
def test_a_recording_makes_a_link_ok(block, master, bridge):
    done = bridge.run(f'rosbag record --duration 5 -O {master.folder}/drive.bag /serial_msg')
    assert done.returncode == 0, done.stdout
    *there, play = lines(block)
    with master.background(there):
        master.until(lambda: '/tmp/bridge: open' in master.output(), 'the port is open')
        with master.background([play]):
            master.until(lambda: master.links_are_ok('arduino'), 'the link is OK')


@marked('run: avr')
def test_a_block_beside_emulated_boards_succeeds(block, master):
    build_firmware()    # may take longer than `until` waits for a launch
    folder = master.folder / 'avr'
    master.environment['SIM_DIR'] = str(folder)
    with master.background([
            f'roslaunch serial_communication bridge.launch sim:=avr sim_dir:={folder}']):
        master.until(lambda: master.links_are_ok(*LINKS), 'all links are OK')

        def answers():      # socat waits for the answer for 0.5 s
            done = master.run(block.text)
            assert done.returncode == 0, done.stdout
            return done.stdout.strip()
        again_if_stalled(answers)


@pytest.mark.parametrize('block', PYTHON, ids=lambda block: getattr(block, 'id', 'none'))
def test_a_python_example_succeeds(block, beside):
    done = beside[block.id].result()
    assert done.returncode == 0 and 'Traceback' not in done.stdout, done.stdout
