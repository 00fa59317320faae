"""The processes of the bench beside the roscore: children that take orders, nodes with boards."""
import json
import os
import pty
import select
import signal
import subprocess
import sys
import tty
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence

from serial_communication.boards import BOARDS
from .boards import TURNS
from .processes import NODE, Child, Stage, StageError

ROOT = Path(__file__).resolve().parents[2]
_ANSWER = 120.0   # s that an order may take
# Runs a Python program and gives its threads' names to the kernel.
_NAMED_THREADS = '''
import ctypes, runpy, sys, threading
bootstrap = threading.Thread._bootstrap
def named(self):
    ctypes.CDLL(None).prctl(15, self.name.encode(), 0, 0, 0)
    bootstrap(self)
threading.Thread._bootstrap = named
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name='__main__')
'''


class Servant(Child):
    """A process that takes orders and answers them; see child.py."""

    def begin(self, do: str, **arguments: Any) -> None:
        """Give an order without waiting for its answer."""
        self.order(json.dumps(dict(arguments, do=do)))

    def answer(self) -> Any:
        """Return the answer to the last order."""
        arrived = select.select([self.process.stdout], [], [], _ANSWER)[0]
        line = self.process.stdout.readline() if arrived else b''
        if not line:
            raise self.fault()
        return json.loads(line)

    def ask(self, do: str, **arguments: Any) -> Any:
        """Give an order and return its answer."""
        self.begin(do, **arguments)
        return self.answer()

    def ask_to_end(self, number: int = signal.SIGTERM) -> None:
        """Request the end of the process, by closing its stdin."""
        try:
            self.process.stdin.close()
        except OSError:
            pass


class Side(NamedTuple):
    """A node and its boards: one side of a comparison."""

    node: str       # its name in ROS
    child: Child
    talkers: Dict[str, Servant]     # the boards that send unasked, by link
    others: Dict[str, Servant]      # the bus board and the listener

    def talk(self, seconds: float) -> Dict[str, list]:
        """Let the talkers send for `seconds`; return the times of what they sent, by link."""
        self.begin_talking(seconds)
        return self.end_talking()

    def begin_talking(self, seconds: float) -> None:
        """The first half of `talk`, so that boards of other sides can send at the same time."""
        for talker in self.talkers.values():
            talker.begin('talk', seconds=seconds)

    def end_talking(self) -> Dict[str, list]:
        """The second half of `talk`."""
        return {link: talker.answer() for link, talker in self.talkers.items()}


class BenchStage(Stage):
    """Runs one section after another. `clear` ends the processes of a section.

    Args:
        against: a commit whose bridge is measured in the same rounds, or ''.
    """

    def __init__(self, against: str = '') -> None:
        super().__init__('serial_communication_bench_')
        self._fds: List[int] = []
        node = [sys.executable, '-c', _NAMED_THREADS]
        script = 'scripts/serial_communication_node'
        self.bridges = {'bridge': [*node, str(ROOT / script)]}
        if against:
            source, build = Path(self.path('source')), Path(self.path('build'))
            try:
                _build(against, source, build)
            except BaseException:
                self.discard()
                raise
            self.bridges[against] = [
                'bash', '-c', f'. "{build}/devel/setup.bash" && exec "$@"', 'bash', *node,
                str(source / script)]

    def __exit__(self, *_: Any) -> None:
        super().__exit__()
        self.discard()

    def clear(self) -> None:
        super().clear()
        while self._fds:
            os.close(self._fds.pop())

    def servant(self, module: str, role: str, *arguments: Any, namespace: str = '',
                **options: Any) -> Servant:
        """Start a module of the bench that takes orders."""
        command = [sys.executable, '-m', f'{__package__}.{module}', role, *map(str, arguments)]
        return self.add(Servant(f'{namespace} {role}', command, self.folder,
                                self._env({'namespace': namespace}), orders=True,
                                stdout=subprocess.PIPE, **options))

    def side(self, name: str, links: Sequence[str] = BOARDS,
             parameters: Optional[Dict[str, Any]] = None) -> Side:
        """Start a bridge of `self.bridges`, or the polling node, with its own boards."""
        namespace = f'/side{len(self._fds)}'
        ports, talkers, others = {}, {}, {}
        for link in links:
            master, slave = pty.openpty()
            tty.setraw(slave)
            self._fds += [master, slave]
            ports[link] = os.ttyname(slave)

            def board(role: str, *arguments: str) -> Servant:
                # A board is another computer, so load on the robot's computer must not delay it.
                # The listener is above the bridge's heartbeats, so that it stamps them in time.
                return self.servant('boards', role, master, *arguments, namespace=namespace,
                                    fds=(master,), priority=30 if role == 'listener' else 5)
            if link in TURNS:
                talkers[link] = board('talker', link)
            else:
                others[link] = board('bus')
            if link == 'arduino':
                others['listener'] = board('listener')
        if name == 'polling':
            child: Child = self.servant('nodes', 'polling', ports['arduino'], namespace=namespace)
        else:
            child = self.bridge(ports, parameters or {}, f'{name} {namespace}', self.bridges[name],
                                namespace=namespace)
        return Side(f'{namespace}/{NODE}', child, talkers, others)


def _build(commit: str, source: Path, build: Path) -> None:
    """Build a commit in its own folder; nothing of it is imported here."""
    source.mkdir()
    for command in (f'git -C "{ROOT}" archive "$0" | tar -x -C "{source}"',
                    f'cmake -S "{source}" -B "{build}" -DPYTHON_EXECUTABLE=/usr/bin/python3 '
                    '-DCATKIN_ENABLE_TESTING=OFF', f'make -C "{build}"'):
        done = subprocess.run(['bash', '-o', 'pipefail', '-c', command, commit], text=True,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        if done.returncode:
            raise StageError(f'--against {commit}: {done.stdout[-1500:].strip()}')
