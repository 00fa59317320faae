"""A ROS master and a bridge for the commands of the pages, and ways to run them."""
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Callable, Dict, Iterator, List
from xmlrpc.client import ServerProxy

import rosgraph

PATIENCE = 60.0     # s; only a command that fails takes as long
LEVELS = Path(__file__).with_name('levels.py')


def until(condition, what: str, seconds: float = PATIENCE) -> None:
    """Wait for a condition; AssertionError after `seconds`."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f'not within {seconds:g} s: {what}'
        time.sleep(0.05)


class Stage:
    """An environment for commands, in which a master of its own runs.

    Args:
        folder: where outputs and the simulated boards' ports go.
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
        self._levels = folder / 'levels'      # what levels.py prints …
        self._began_at = 0                    # … and how long that was as the background began

    @contextlib.contextmanager
    def master(self) -> Iterator['Stage']:
        """With a roscore, and what looks at the links."""
        self._levels.touch()
        master = rosgraph.Master('/docs', self.environment['ROS_MASTER_URI'])
        with self.background([f'roscore -p {self._port}']):
            until(lambda: _answers(master.getPid), 'the master answers')
            with self.background([f'{sys.executable} {LEVELS} >{self._levels}']):
                yield self

    @contextlib.contextmanager
    def background(self, commands: List[str]) -> Iterator[None]:
        """Commands that run until the block ends, started in their order."""
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
        """A block of commands, one after the other, as in a terminal; the first failure ends it."""
        return subprocess.run(
            ['bash', '-e', '-o', 'pipefail', '-c', script], env=self.environment,
            cwd=str(self.folder), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, timeout=PATIENCE * 3, check=False)

    def links_are_ok(self, *links: str, or_warn: bool = False) -> bool:
        """Whether the last status of each of these links says so, or that it merely warns.

        Only what has come since the commands in the background were started counts.
        """
        levels = ('OK', 'WARN') if or_warn else ('OK',)
        said = self._levels.read_text()[self._began_at:]
        last = dict(line.split() for line in said.splitlines(True) if line.endswith('\n'))
        return all(last.get(link) in levels for link in links)

    def node_lives(self, name: str) -> bool:
        """Whether a node of this name answers."""
        master = rosgraph.Master('/docs', self.environment['ROS_MASTER_URI'])
        return _answers(lambda: ServerProxy(master.lookupNode(name)).getPid('/docs'))

    def output(self) -> str:
        """What the commands in the background have said."""
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
