"""The processes of the bench: a separate roscore, the node and other children.

All of them end with the `with` block, or with the process that started them, whatever happens.
"""
import contextlib
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
from typing import Any, Callable, Dict, List, Optional, Sequence

import psutil
import rosgraph

NODE = 'serial_communication'
_PR_SET_PDEATHSIG = 1
_START = 30.0            # s that anything may take to start
_GRACE = 6.0             # s that a child may take to end


class StageError(RuntimeError):
    """The bench itself did not work; the text says why."""


_ENDS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP


class Child:
    """A child process.

    Args:
        folder: its working directory, which also has its log.
        priority: its real-time priority, if the system allows it; 0: none.
        orders: whether it reads its stdin.
        stdout, stderr: a descriptor, or subprocess.PIPE for stdout; None: its log.
        fds: descriptors that it inherits.
    """

    def __init__(self, name: str, command: Sequence[str], folder: str, env: Dict[str, str],
                 priority: int = 0, orders: bool = False, stdout: Optional[int] = None,
                 stderr: Optional[int] = None, fds: Sequence[int] = ()) -> None:
        self.name = name
        self.log = os.path.join(folder, name.replace('/', '_').replace(' ', '_') + '.out')
        with open(self.log, 'ab') as log:
            # Python ignores what a signal handler raises during a fork. So signals are blocked.
            signal.pthread_sigmask(signal.SIG_BLOCK, _ENDS)
            try:
                self.process = subprocess.Popen(
                    command, stdin=subprocess.PIPE if orders else subprocess.DEVNULL,
                    stdout=log if stdout is None else stdout,
                    stderr=log if stderr is None else stderr, pass_fds=fds, env=env, cwd=folder,
                    start_new_session=True, preexec_fn=lambda: _before_exec(priority))
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDS)

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def order(self, text: str) -> None:
        """Write a line to its stdin; StageError if it has ended."""
        try:
            self.process.stdin.write(text.encode() + b'\n')
            self.process.stdin.flush()
        except OSError:
            raise self.fault() from None

    def fault(self) -> StageError:
        """Return the error to raise if the process does not do what it should."""
        return StageError(f"{self.name} {'hangs' if self.alive else 'has ended'}: "
                          f"{self.tail() or 'it printed nothing'}")

    def send(self, number: int) -> None:
        """Send a signal, if it is still running."""
        if self.alive:
            self.process.send_signal(number)

    def hold(self) -> None:
        """Suspend it until it is sent SIGCONT; returns when it is suspended or has ended."""
        self.send(signal.SIGSTOP)
        os.waitid(os.P_PID, self.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)

    def ask_to_end(self, number: int = signal.SIGTERM) -> None:
        """Send it the signal, also if it is suspended."""
        self.send(signal.SIGCONT)
        self.send(number)

    def end(self, number: int = signal.SIGTERM, grace: float = _GRACE) -> float:
        """Send the signal and wait; kill it after `grace` s. Return the seconds that it took."""
        began = time.monotonic()
        self.ask_to_end(number)
        self.join(grace)
        return time.monotonic() - began

    def join(self, grace: float) -> None:
        """Wait for its end; after `grace` s kill it and all that it has started."""
        try:
            self.process.wait(max(0.0, grace))
        except subprocess.TimeoutExpired:
            # It is suspended so that it starts nothing else. A roscore's processes have their own
            # groups, and it may wait over 15 s for one of them.
            self.hold()
            started = _descendants(self.pid)
            self.process.kill()
            self.process.wait()
            for process in started:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
            psutil.wait_procs(started, _GRACE)
        for stream in (self.process.stdin, self.process.stdout):
            try:
                if stream:
                    stream.close()
            except OSError:
                pass        # it ended without having read all

    def tail(self) -> str:
        """Return the end of its log."""
        with open(self.log, errors='replace') as log:
            return log.read()[-1500:].strip()

    def cpu_seconds(self) -> float:
        """User and system time of all its threads so far; StageError if it has ended."""
        if not self.alive:
            raise self.fault()
        # The process's CPU clock: the sum in /proc/PID/stat, in ns instead of ticks of 10 ms.
        return time.clock_gettime((~self.pid << 3) | 2)


class Stage:
    """A folder, a roscore, and children.

    Args:
        prefix: of the name of a temporary folder.
        folder: used instead, and kept.
        bridge: a command that is run instead of the node.
    """

    def __init__(self, prefix: str, folder: str = '', bridge: str = '') -> None:
        self.folder = os.path.abspath(folder) if folder else tempfile.mkdtemp(prefix=prefix)
        os.makedirs(self.folder, exist_ok=True)
        self.kept = bool(folder)
        self.children: List[Child] = []
        self._bridge = shlex.split(bridge) or [
            sys.executable, '-c', 'from serial_communication.ros.node import main; main()']
        self._core: Optional[Child] = None
        self._port = _free_port()
        self.env = {key: value for key, value in os.environ.items()
                    if key not in ('ROS_IP', 'ROS_NAMESPACE')}
        self.env.update(ROS_MASTER_URI=f'http://127.0.0.1:{self._port}',
                        ROS_HOSTNAME='127.0.0.1', ROS_LOG_DIR=self.folder,
                        ROS_HOME=self.folder, PYTHONUNBUFFERED='1')
        os.environ.update(self.env)      # for the master's and the nodes' APIs in this process

    def __enter__(self) -> 'Stage':
        try:
            self.start_master()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: Any) -> None:
        self.clear()
        self.end_master()
        self._end_unlisted()

    def start_master(self) -> None:
        """Start a roscore, always at the same address, and wait until it answers."""
        core = self.launch_master()
        master = rosgraph.Master('/stage')
        self.wait(lambda: _answers(master) or not core.alive, 'roscore')
        if not core.alive:
            raise StageError(f'roscore does not start: {core.tail()}')

    def launch_master(self) -> Child:
        """Start a roscore without waiting for it."""
        self._core = Child('roscore', ['roscore', '-p', str(self._port)], self.folder, self.env)
        return self._core

    def end_master(self) -> None:
        """End the roscore and wait for its end."""
        if self._core:
            self._core.end()
            self._core = None

    def discard(self) -> None:
        """Delete the folder, unless it is to be kept."""
        if not self.kept:
            shutil.rmtree(self.folder, ignore_errors=True)

    def path(self, name: str) -> str:
        return os.path.join(self.folder, name)

    # -- children -------------------------------------------------------------------------

    def child(self, name: str, command: Sequence[str], **options: Any) -> Child:
        """Start a child; `options` are those of Child, and `namespace` for a node."""
        return self.add(Child(name, command, self.folder, self._env(options), **options))

    def _env(self, options: Dict[str, Any]) -> Dict[str, str]:
        namespace = options.pop('namespace', '')
        return dict(self.env, ROS_NAMESPACE=namespace) if namespace else self.env

    def add(self, child: Child) -> Any:
        """Return the child, which will end with the stage."""
        self.children.append(child)
        return child

    def end(self, child: Child, number: int = signal.SIGTERM, grace: float = _GRACE) -> float:
        """End a child; return the seconds that it took."""
        took = child.end(number, grace)
        if child in self.children:
            self.children.remove(child)
        return took

    def clear(self) -> None:
        """End every child."""
        # The users of a node first: they would log errors if the node ended before them.
        for child in reversed(self.children):
            child.ask_to_end()
        deadline = time.monotonic() + _GRACE
        for child in reversed(self.children):
            child.join(max(0.5, deadline - time.monotonic()))
        self.children.clear()

    def _end_unlisted(self) -> None:
        """End a process that a Ctrl-C kept out of the list of children."""
        left = [process for process in psutil.Process().children()
                if _runs_in(process, self.folder)]
        for process in left:
            process.terminate()
        for process in psutil.wait_procs(left, _GRACE)[1]:
            process.kill()
            process.wait()

    def check(self, *children: Child) -> None:
        """Raise StageError if one of them has ended."""
        for child in children:
            if not child.alive:
                raise child.fault()

    def bridge(self, ports: Dict[str, str], parameters: Dict[str, Any], name: str = 'bridge',
               command: Sequence[str] = (), **options: Any) -> Child:
        """Start the node with these parameters (``arduino/speed_timeout``), and no earlier ones.

        Args:
            command: run instead of the node.
            options: with `namespace`, its /diagnostics are in that namespace, too.
        """
        namespace = options.get('namespace', '')
        _forget_parameters(f'{namespace}/{NODE}')
        given = dict({f'{link}/port': port for link, port in ports.items()}, **parameters)
        arguments = [f'_{key}:={str(value).lower() if isinstance(value, bool) else value}'
                     for key, value in given.items()]
        if namespace:
            arguments.append(f'/diagnostics:={namespace}/diagnostics')
        return self.child(name, [*(command or self._bridge), f'__name:={NODE}', *arguments],
                          **options)

    def busy(self, number: int) -> List[Child]:
        """Start processes that use all the CPU time they get."""
        return [self.child(f'busy{index}', [sys.executable, '-c', 'while True: pass'])
                for index in range(number)]

    # -- waiting --------------------------------------------------------------------------

    @staticmethod
    def wait(condition: Callable[[], Any], what: str, seconds: float = _START) -> Any:
        """Wait until `condition()` is true, and return its value; StageError after `seconds`."""
        deadline = time.monotonic() + seconds
        while True:
            value = condition()
            if value:
                return value
            if time.monotonic() > deadline:
                raise StageError(f'not within {seconds:g} s: {what}')
            time.sleep(0.02)


def _descendants(pid: int) -> List[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.Error:
        return []       # it has ended


def _runs_in(process: psutil.Process, folder: str) -> bool:
    try:
        return os.path.samefile(process.cwd(), folder)
    except (OSError, psutil.Error):
        return False        # it has ended


def _answers(master: rosgraph.Master) -> bool:
    try:
        return bool(master.getPid())
    except (OSError, rosgraph.MasterException):
        return False


def _forget_parameters(name: str) -> None:
    try:
        rosgraph.Master('/stage').deleteParam(name)
    except rosgraph.MasterException:
        pass        # there are none


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        return free.getsockname()[1]


def _before_exec(priority: int) -> None:
    """In the child: end with the parent; real-time priority if asked for and allowed, else none."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDS)
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    except (OSError, AttributeError):
        pass
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO if priority else os.SCHED_OTHER,
                              os.sched_param(priority))
    except OSError:
        pass
