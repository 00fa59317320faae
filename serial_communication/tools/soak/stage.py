"""What a campaign runs: a roscore of its own, cables, boards, the bridge, its users.

Each is a process of its own, in a folder of the campaign's own; all of them end with the `with`
block, or with the campaign's process, whatever happened.
"""
import ctypes
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from typing import Any, Dict, List, Optional

import rosgraph

from .records import Lines

LINKS = ('bus', 'arduino', 'mcu')
CABLE_PRIORITY = 15      # real-time: between the simulated boards' and the heartbeat's
_PR_SET_PDEATHSIG = 1
_START = 30.0            # s that anything may take to start
_GRACE = 6.0             # s that a child has to end in


class SoakError(RuntimeError):
    """The campaign itself did not work; the text is for a person."""


class Child:
    """One process; its output goes to a file."""

    def __init__(self, name: str, command: List[str], folder: str, env: Dict[str, str],
                 priority: int = 0, orders: bool = False) -> None:
        self.name = name
        self.log = os.path.join(folder, name + '.out')
        with open(self.log, 'ab') as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE if orders else subprocess.DEVNULL, stdout=log,
                stderr=log, env=env, cwd=folder, start_new_session=True,
                preexec_fn=lambda: _before_exec(priority))

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def order(self, text: str) -> None:
        """A line for its stdin."""
        try:
            self.process.stdin.write(text.encode() + b'\n')
            self.process.stdin.flush()
        except OSError:
            pass

    def send(self, number: int) -> None:
        """A signal, if it still lives."""
        if self.alive:
            self.process.send_signal(number)

    def end(self, number: int = signal.SIGTERM, grace: float = _GRACE) -> float:
        """Signal it, wait, force it in the end; the seconds that it took."""
        began = time.monotonic()
        self.send(signal.SIGCONT)
        self.send(number)
        return self.join(grace, began)

    def join(self, grace: float, began: Optional[float] = None) -> float:
        """Wait for its end, force it after `grace`; the seconds that it took."""
        began = time.monotonic() if began is None else began
        try:
            self.process.wait(max(0.0, began + grace - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._kill()
        took = time.monotonic() - began
        if self.process.stdin:
            try:
                self.process.stdin.close()
            except OSError:
                pass
        return took

    def _kill(self) -> None:
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except OSError:
            pass
        self.process.wait()

    def tail(self) -> str:
        """What it said last."""
        with open(self.log, errors='replace') as log:
            return log.read()[-1500:].strip()


class Cable:
    """A socat pair: `near` is the bridge's end, `far` the board's."""

    def __init__(self, stage: 'Stage', name: str) -> None:
        self.name = name
        self.near = os.path.join(stage.folder, name)
        self.far = os.path.join(stage.folder, name + '_board')
        self._stage = stage
        self._child: Optional[Child] = None
        self._spares: List[int] = []

    def plug(self) -> float:
        """Make it; returns when both ends are there: the time."""
        self._child = self._stage.child('cable_' + self.name, [
            self._stage.program('socat_pair'), self.near, self.far], priority=CABLE_PRIORITY)
        deadline = time.monotonic() + _START
        while not (os.path.exists(self.near) and os.path.exists(self.far)):
            if time.monotonic() > deadline or not self._child.alive:
                raise SoakError('socat does not start: %s' % self._child.tail())
            time.sleep(0.002)
        now = time.monotonic()
        self._stage.events.write(t=now, ev='plugged', link=self.name,
                                 device=os.path.realpath(self.near))
        return now

    def unplug(self, another_name: bool = False) -> float:
        """Cut it; with `another_name` it comes back as another device. The time."""
        if another_name:
            # Whoever takes the numbers that become free leaves others for the cable.
            self._spares.append(os.open('/dev/ptmx', os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC))
        now = time.monotonic()
        self._stage.events.write(t=now, ev='unplugged', link=self.name)
        self._child.end(signal.SIGKILL)
        self._stage.forget(self._child)
        for end in (self.near, self.far):
            if os.path.islink(end):
                os.unlink(end)
        if len(self._spares) > 3:
            os.close(self._spares.pop(0))
        return now

    def noise(self, data: bytes) -> bool:
        """Put bytes on the line towards the bridge, which the board does not know of."""
        try:
            fd = os.open(self.far, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            return False
        now = time.monotonic()
        try:
            os.write(fd, data)
            self._stage.events.write(t=now, ev='noise', link=self.name,
                                     data=data.hex())
            return True
        except OSError:
            return False
        finally:
            os.close(fd)

    def close(self) -> None:
        while self._spares:
            os.close(self._spares.pop())


class Stage:
    """A folder, a roscore, and the children."""

    def __init__(self, keep: str = '', bridge: str = '') -> None:
        self.folder = os.path.abspath(keep) if keep else tempfile.mkdtemp(
            prefix='serial_communication_soak_')
        os.makedirs(self.folder, exist_ok=True)
        self.kept = bool(keep)
        self.events = Lines(self.path('events.jsonl'))
        self.children: List[Child] = []
        self.cables: Dict[str, Cable] = {}
        self._bridge = shlex.split(bridge)
        self._port = _free_port()
        self.env = {key: value for key, value in os.environ.items()
                    if key not in ('ROS_IP', 'ROS_NAMESPACE')}
        self.env.update(ROS_MASTER_URI='http://127.0.0.1:%d' % self._port,
                        ROS_HOSTNAME='127.0.0.1', ROS_LOG_DIR=self.path('log'),
                        ROS_HOME=self.folder, PYTHONUNBUFFERED='1')
        os.environ.update(self.env)      # for the master's API in this process

    def __enter__(self) -> 'Stage':
        try:
            core = self.child('roscore', ['roscore', '-p', str(self._port)])
            master = rosgraph.Master('/soak')
            self.wait(lambda: _answers(master) or not core.alive, 'roscore')
            if not core.alive:
                raise SoakError('roscore does not start: %s' % core.tail())
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: Any) -> None:
        for child in reversed(self.children):
            child.send(signal.SIGCONT)
            child.send(signal.SIGTERM)
        deadline = time.monotonic() + _GRACE
        for child in reversed(self.children):
            child.join(max(0.5, deadline - time.monotonic()))
        self.children.clear()
        for cable in self.cables.values():
            cable.close()
        self.events.close()

    def discard(self) -> None:
        """Delete the records, unless they are to be kept."""
        if not self.kept:
            shutil.rmtree(self.folder, ignore_errors=True)

    def path(self, name: str) -> str:
        return os.path.join(self.folder, name)

    # -- children -------------------------------------------------------------------------

    def child(self, name: str, command: List[str], **options: Any) -> Child:
        """Start one."""
        child = Child(name, command, self.folder, self.env, **options)
        self.children.append(child)
        return child

    def forget(self, child: Child) -> None:
        """It has ended."""
        if child in self.children:
            self.children.remove(child)

    def end(self, child: Child, number: int = signal.SIGTERM, grace: float = _GRACE) -> float:
        """End one; the seconds that it took."""
        took = child.end(number, grace)
        self.forget(child)
        return took

    def cable(self, name: str) -> Cable:
        """A new one, plugged in."""
        cable = self.cables[name] = Cable(self, name)
        cable.plug()
        return cable

    def board(self, kind: str, far: str, seed: int, *options: str, journal: str = '',
              name: str = '') -> Child:
        """A simulated board."""
        return self.child(name or kind + '_board', [
            sys.executable, '-c', 'import sys; from serial_communication.simulation.cli import '
            'main; sys.exit(main())', kind, '--port', far, '--seed', str(seed),
            '--journal', journal or self.path(kind + '.journal'), *options])

    def bridge(self, ports: Dict[str, str], parameters: Dict[str, Any],
               name: str = 'bridge') -> Child:
        """The node; `parameters` by their names, with the slash. Those of one before it go."""
        _forget_parameters()
        command = self._bridge or [
            sys.executable, '-c', 'from serial_communication.ros.node import main; main()']
        arguments = ['_%s/port:=%s' % port for port in ports.items()]
        arguments += ['_%s:=%s' % (key, str(value).lower() if isinstance(value, bool) else value)
                      for key, value in parameters.items()]
        return self.child(name, command + ['__name:=serial_communication'] + arguments)

    def user(self, role: str, file: str, seed: int, **options: Any) -> Child:
        """A process of children.py."""
        return self.child(role, [sys.executable, '-m', __package__ + '.children', role,
                                 self.path(file), str(seed)], **options)

    def program(self, name: str) -> str:
        """A script of this package, in a checkout or installed."""
        here = os.path.join(os.path.dirname(os.path.realpath(__file__)), *[os.pardir] * 3,
                            'scripts', name)
        if os.path.exists(here):
            return here
        import rospkg
        package = rospkg.RosPack().get_path('serial_communication')
        for folder in (os.path.join(package, 'scripts'),
                       os.path.join(package, os.pardir, os.pardir, 'lib',
                                    'serial_communication')):
            if os.path.exists(os.path.join(folder, name)):
                return os.path.join(folder, name)
        return name

    # -- waiting --------------------------------------------------------------------------

    def wait(self, condition, what: str, seconds: float = _START) -> Any:
        """Until `condition()`, which is returned; SoakError after `seconds`."""
        deadline = time.monotonic() + seconds
        while True:
            value = condition()
            if value:
                return value
            if time.monotonic() > deadline:
                raise SoakError('not within %g s: %s' % (seconds, what))
            time.sleep(0.02)


def _answers(master: rosgraph.Master) -> bool:
    try:
        return bool(master.getPid())
    except (OSError, rosgraph.MasterException):
        return False


def _forget_parameters() -> None:
    try:
        rosgraph.Master('/soak').deleteParam('/serial_communication')
    except rosgraph.MasterException:
        pass        # there are none


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        return free.getsockname()[1]


def _before_exec(priority: int) -> None:
    """In the child: end with the parent; real-time priority if asked for and allowed."""
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    except (OSError, AttributeError):
        pass
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError:
            pass
