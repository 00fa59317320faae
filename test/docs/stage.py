"""A ROS master and a bridge for the commands of the pages, and ways to run them."""
import contextlib
import os
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Dict, Iterator, List

import rosgraph

PATIENCE = 60.0     # s; only a command that fails takes as long


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

    @contextlib.contextmanager
    def master(self) -> Iterator['Stage']:
        """With a roscore."""
        master = rosgraph.Master('/docs', self.environment['ROS_MASTER_URI'])
        with self.background([f'roscore -p {self._port}']):
            until(lambda: _answers(master), 'the master answers')
            yield self

    @contextlib.contextmanager
    def background(self, commands: List[str]) -> Iterator[None]:
        """Commands that run until the block ends, started in their order."""
        running = []
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
        """Whether the monitor says so of each of these links, or that it merely warns."""
        said = self.run('rosrun serial_communication monitor --once || true').stdout
        levels = ('OK', 'WARN') if or_warn else ('OK',)
        return all(any(line.split()[:2] == [link, level] for line in said.splitlines()
                       for level in levels) for link in links)

    def output(self) -> str:
        """What the commands in the background have said."""
        path = self.folder / 'output'
        return path.read_text(errors='replace') if path.exists() else ''


def _answers(master: rosgraph.Master) -> bool:
    try:
        master.getPid()
        return True
    except OSError:
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
