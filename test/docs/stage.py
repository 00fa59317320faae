"""A ROS master for the commands of the pages, and functions to run them."""
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Callable, Dict, Iterator, List
from xmlrpc.client import ServerProxy

import rosgraph
import waiting
from waiting import PATIENCE

LEVELS = Path(__file__).with_name('levels.py')

until = partial(waiting.until, every=0.05)


class Stage:
    """An environment for commands, with its own master.

    Args:
        folder: for output and the ports of simulated boards.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(('127.0.0.1', 0))
            port = probe.getsockname()[1]
        self.environment: Dict[str, str] = dict(
            os.environ, ROS_MASTER_URI=f'http://localhost:{port}', ROS_HOSTNAME='localhost',
            ROS_LOG_DIR=str(folder / 'log'), PATH=f'/usr/bin:{os.environ["PATH"]}')
        self._port = port
        self._levels = folder / 'levels'      # the output of levels.py …
        self._began_at = 0                    # … and its length at the start of `background`

    @contextlib.contextmanager
    def master(self) -> Iterator['Stage']:
        """Run a roscore, and levels.py, until the block ends."""
        self._levels.touch()
        master = rosgraph.Master('/docs', self.environment['ROS_MASTER_URI'])
        with self.background([f'roscore -p {self._port}']):
            until(lambda: _answers(master.getPid), 'the master answers')
            with self.background([f'{sys.executable} {LEVELS} >{self._levels}']):
                yield self

    @contextlib.contextmanager
    def background(self, commands: List[str]) -> Iterator[None]:
        """Start commands in order, and end them with the block."""
        running = []
        self._began_at = self._levels.stat().st_size if self._levels.exists() else 0
        try:
            for command in commands:
                output = (self.folder / 'output').open('a')
                running.append(subprocess.Popen(
                    ['bash', '-c', f'exec {command}'], env=self.environment, cwd=str(self.folder),
                    stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                    start_new_session=True))
                output.close()
            yield
        finally:
            for process in reversed(running):
                _end(process)

    def run(self, script: str) -> 'subprocess.CompletedProcess[str]':
        """Run a block of commands in order, as in a terminal; the first failure ends it."""
        return subprocess.run(
            ['bash', '-e', '-o', 'pipefail', '-c', script], env=self.environment,
            cwd=str(self.folder), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, timeout=PATIENCE * 3, check=False)

    def links_are_ok(self, *links: str, or_warn: bool = False) -> bool:
        """Whether the last status of each of these links is OK; with `or_warn`, or WARN.

        Only statuses since the start of the commands in the background count.
        """
        levels = ('OK', 'WARN') if or_warn else ('OK',)
        levels_since = self._levels.read_text()[self._began_at:]
        last = dict(line.split() for line in levels_since.splitlines(True) if line.endswith('\n'))
        return all(last.get(link) in levels for link in links)

    def run_while_ok(self, script: str, *links: str) -> 'subprocess.CompletedProcess[str]':
        """Run a block of commands; again if it failed while a link was not OK.

        On a busy machine simulated boards may get too little processor time.
        """
        deadline = time.monotonic() + PATIENCE
        while True:
            self.until(lambda: self.links_are_ok(*links), 'all links are OK')
            before = self._levels.stat().st_size
            done = self.run(script)
            meanwhile = self._levels.read_text()[before:].split()[1::2]
            # levels.py counts late heartbeats as OK.
            if not done.returncode or time.monotonic() > deadline or not (
                    {'WARN', 'ERROR'} & set(meanwhile) or 'heartbeat gap of' in done.stdout):
                return done

    def node_answers(self, name: str) -> bool:
        """Whether a node with this name answers."""
        master = rosgraph.Master('/docs', self.environment['ROS_MASTER_URI'])
        return _answers(lambda: ServerProxy(master.lookupNode(name)).getPid('/docs'))

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait as `until` does; an error has the output of the commands in the background."""
        try:
            until(condition, what)
        except AssertionError as error:
            raise AssertionError(f'{error}: {self.output()}') from None

    def output(self) -> str:
        """Return the output of the commands in the background."""
        path = self.folder / 'output'
        return path.read_text(errors='replace') if path.exists() else ''


def _answers(question: Callable[[], object]) -> bool:
    try:
        question()
        return True
    except (OSError, rosgraph.MasterException):
        return False


def _end(process: 'subprocess.Popen[bytes]') -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(OSError):
            os.killpg(process.pid, number)
        try:
            process.wait(15)
            return
        except subprocess.TimeoutExpired:
            pass
