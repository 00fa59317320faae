"""Follows the recipes of doc/recipes.md with the files that the page shows."""
import contextlib
import os
import re
import shlex
import signal
import subprocess

import pytest
from pages import ROOT, blocks
from stage import Stage
from waiting import PATIENCE, again_if_stalled

PAGE = ROOT / 'doc' / 'recipes.md'
UNIT = ROOT / 'config' / 'serial_communication.service'


def recipes():
    """The commands of each recipe: steps that come first, its launch, and commands beside that."""
    found = {}
    headings = [number for number, line in enumerate(PAGE.read_text().splitlines(), 1)
                if line.startswith('## ')]
    for block in blocks(PAGE):
        if block.mark == 'run by: scripts/test docs':
            recipe = max(number for number in headings if number < block.line)
            found.setdefault(recipe, []).append(block.text.strip())
    return [(steps, launch, commands) for *steps, launch, commands in found.values()]


@pytest.fixture(scope='module')
def master(tmp_path_factory):
    """A master, in a folder with the files of the page."""
    folder = tmp_path_factory.mktemp('recipes')
    for block in blocks(PAGE):
        if block.mark.startswith('file: '):
            path = folder / block.mark.partition(' ')[2]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
    with Stage(folder).master() as stage:
        yield stage


@pytest.fixture
def terminal(master, monkeypatch):
    """The master, in a terminal whose variables are forgotten."""
    monkeypatch.setattr(master, 'environment', dict(master.environment))
    return master


def succeeds(terminal, command):
    """Whether a command succeeds. A call that nothing was sent for may be made again."""
    done = terminal.run(f'timeout {PATIENCE:g} {command}')
    assert done.returncode == 0 and done.stdout.strip(), (command, done.stdout)
    refused = 'success: False' in done.stdout
    assert not refused or 'nothing was sent' in done.stdout, (command, done.stdout)
    return not refused


@pytest.mark.parametrize('steps, launch, commands', recipes())
def test_the_commands_of_a_recipe_succeed_beside_its_launch(terminal, steps, launch, commands):
    for step in steps:
        done = terminal.run(f'{step}\nenv -0 >environment')    # as in one terminal
        assert done.returncode == 0, done.stdout
        terminal.environment.update(pair.split('=', 1) for pair in (
            terminal.folder / 'environment').read_text().split('\0') if pair)
    with terminal.background([launch]):
        terminal.until(lambda: terminal.links_are_ok('bus', 'arduino', 'mcu'), 'all links are OK')
        for command in commands.splitlines():
            again_if_stalled(lambda command=command: succeeds(terminal, command))


def unit():
    """The settings of the unit by name."""
    return dict(re.findall(r'^(\w+)=(.*)$', UNIT.read_text(), re.MULTILINE))


def test_systemd_accepts_the_unit():
    done = subprocess.run(['systemd-analyze', 'verify', str(UNIT)], stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, '')


def test_the_command_of_the_unit_starts_the_bridge_and_its_signal_ends_it(master):
    settings = unit()
    assert (settings['KillSignal'], settings['KillMode']) == ('SIGINT', 'mixed')
    command = [word.replace('/home/robot/catkin_ws', str(ROOT / 'build'))
               .replace('/home/robot/boards.yaml', str(ROOT / 'config' / 'bridge.yaml'))
               for word in shlex.split(settings['ExecStart'])]
    with open(str(master.folder / 'output'), 'a') as output:
        process = subprocess.Popen(command, env=master.environment, stdin=subprocess.DEVNULL,
                                   stdout=output, stderr=output, start_new_session=True)
    try:
        master.until(lambda: master.node_answers('/serial_communication'), 'the bridge answers')
        process.send_signal(signal.SIGINT)      # KillMode=mixed: to the main process alone
        assert process.wait(int(settings['TimeoutStopSec'])) == 0
        assert not master.node_answers('/serial_communication')
    finally:
        with contextlib.suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)
