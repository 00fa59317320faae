"""Runs the commands of the pages, and the boot unit's.

A comment right before a block of commands tells how to run it:

    <!-- run: bridge -->       beside a bridge with simulated boards, as each Python example
    <!-- run: first -->        before the next launch, and in each terminal from then on
    <!-- run: launch -->       each line starts a bridge, whose links all become OK
    <!-- run: beside -->       beside the bridge of the last launch
    <!-- run: background -->   all at the same time; then the bus link becomes OK
    <!-- file: NAME -->        not a command: a file that the commands of the page need
    <!-- run by: PART -->      by a test in that part of scripts/test
    <!-- needs a board -->     not run; likewise `needs a screen`, `a container`, `a network`,
                               `a workspace`
"""
import contextlib
import os
import re
import signal
import subprocess
import sys
import threading

import pytest
import yaml
from pages import PAGES, ROOT, blocks
from waiting import PATIENCE, again_if_stalled, until

sys.path.insert(0, str(ROOT / 'test' / 'ros'))
from boards import ERROR, OK, Master  # noqa: E402

BLOCKS = [block for page in PAGES for block in blocks(page)]
BESIDE = [block for block in BLOCKS if block.mark == 'run: bridge'
          or block.language == 'python' and not block.mark]
BACKGROUND = [block for block in BLOCKS if block.mark == 'run: background']
LINKS = ('bus', 'arduino', 'mcu')
UNIT = ROOT / 'config' / 'serial_communication.service'


def launches():
    """Each line that starts a bridge, with what comes first, and the commands beside it."""
    found, first = [], ''
    for block in BLOCKS:
        if block.mark == 'run: first':
            first = block.text
        elif block.mark == 'run: launch':
            found += [(first, line, []) for line in lines(block) if 'sim:=avr' not in line]
            first = ''
        elif block.mark == 'run: beside':
            found[-1][2].extend(lines(block))
    return [each for number, each in enumerate(found) if each not in found[:number]]


def lines(block):
    """The commands of a block with one command per line."""
    return [line.partition('  #')[0].strip() for line in block.text.splitlines() if line.strip()]


class Stage:
    """A ROS master, and a folder with the files of the pages in which commands run."""

    def __init__(self, folder):
        self.folder, self.levels = folder, {}
        for block in BLOCKS:
            if block.mark.startswith('file: '):
                path = folder / block.mark.partition(' ')[2]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block.text)
        # Not by rospy: a process has one node, and this one may be that of other tests.
        self.echo = subprocess.Popen(['rostopic', 'echo', '/diagnostics'], text=True,
                                     stdout=subprocess.PIPE)
        threading.Thread(target=self._take, daemon=True).start()

    def _take(self):
        for message in yaml.safe_load_all(self.echo.stdout):
            for status in message['status'] if message else ():
                link = status['name'].rpartition(': ')[2].split()[0]
                self.levels[link] = min(status['level'],
                                        self.levels.get(link, status['level']))

    @contextlib.contextmanager
    def background(self, *commands):
        """Run commands until the block ends, without parameters of a bridge that ran before."""
        self.levels, running = {}, []
        subprocess.run(['rosparam', 'delete', '/serial_communication'], check=False,
                       stderr=subprocess.DEVNULL)
        try:
            with (self.folder / 'output').open('a') as output:
                for command in commands:
                    running.append(subprocess.Popen(
                        ['bash', '-e', '-c', command], cwd=str(self.folder), stdout=output,
                        stderr=output, stdin=subprocess.DEVNULL, start_new_session=True))
            yield
        finally:
            for process in reversed(running):
                for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
                    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                        os.killpg(process.pid, number)
                        process.wait(15)

    def until_links(self, *links, worst=OK):
        """Wait until each link was at this level or a better one."""
        try:
            until(lambda: all(self.levels.get(link, ERROR + 1) <= worst for link in links))
        except AssertionError:
            output = (self.folder / 'output').read_text(errors='replace')
            raise AssertionError(f'{links}: {self.levels}\n{output}') from None

    def succeeds(self, command):
        """Run commands, again if they fail: a bridge may refuse calls after a stall."""
        def attempt():
            done = subprocess.run(
                ['bash', '-e', '-o', 'pipefail', '-c', command], cwd=str(self.folder),
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                text=True, timeout=3 * PATIENCE)
            print(done.stdout)
            return not done.returncode and 'success: False' not in done.stdout
        again_if_stalled(attempt, tries=3)


@pytest.fixture(scope='module', name='stage')
def fixture_stage(tmp_path_factory):
    master = Master()
    os.environ.update(ROS_MASTER_URI=master.uri, PATH=f'/usr/bin:{os.environ["PATH"]}')
    try:
        master.start()
        stage = Stage(tmp_path_factory.mktemp('pages'))
        yield stage
        stage.echo.kill()
    finally:
        master.end()


def test_every_block_of_commands_has_a_mark():
    known = r'run: (bridge|first|launch|beside|background)|run by: scripts/test \w+|' \
        'needs a (board|screen|container|network|workspace)'
    assert [block.id for block in BLOCKS
            if block.language == 'sh' and not re.fullmatch(known, block.mark)] == []


@pytest.mark.parametrize('first, launch, commands', launches())
def test_a_launched_bridge_becomes_ok(first, launch, commands, stage):
    with stage.background(f'{first}\n{launch}'):
        # With faults on the lines, errors are expected.
        stage.until_links(*LINKS, worst=ERROR - 1 if 'faults:=' in launch else OK)
        for command in commands:
            stage.succeeds(f'{first}\ntimeout {PATIENCE:g} {command}')


@pytest.mark.parametrize('block', BACKGROUND, ids=lambda block: block.id)
def test_commands_in_the_background_make_a_link_ok(block, stage):
    with stage.background(*lines(block)):
        stage.until_links('bus')


def test_the_command_of_the_boot_unit_starts_the_bridge(stage):
    command = re.search('^ExecStart=(.*)$', UNIT.read_text(), re.MULTILINE).group(1)
    with stage.background(command.replace('/home/robot/catkin_ws', str(ROOT / 'build')).replace(
            '/home/robot/boards.yaml', str(ROOT / 'config' / 'bridge.yaml'))):
        stage.until_links(*LINKS, worst=ERROR)


@pytest.fixture(scope='module', name='bridge')
def fixture_bridge(stage):
    """The stage, beside a bridge with simulated boards, which ends with the last test."""
    with stage.background(
            'roslaunch serial_communication bridge.launch sim:=true publish_tf:=true'):
        stage.until_links(*LINKS)
        yield stage


@pytest.mark.parametrize('block', BESIDE, ids=lambda block: block.id)
def test_commands_beside_a_bridge_succeed(block, bridge):
    command = block.text
    if block.language == 'python':
        (bridge.folder / 'example.py').write_text(command)
        command = '/usr/bin/python3 example.py'
    bridge.succeeds(command)
