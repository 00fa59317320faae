"""What the bench stands on: a roscore of its own, ptys, child processes, their CPU time.

Everything ends with the `with` block, whatever happened inside, or with the bench's process.
"""
import ctypes
import json
import os
import platform
import pty
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tty
from typing import Any, Dict, List, Optional, Tuple

import rosgraph

LINKS = ('arduino', 'mcu', 'bus')
_PR_SET_PDEATHSIG = 1
_START = 30.0     # s that anything may take to start
_ANSWER = 300.0   # s that an order may take


class BenchError(RuntimeError):
    """The bench itself did not work; the text is for a person."""


class Child:
    """One process; if it takes orders, see child.py."""

    def __init__(self, stage: 'Stage', name: str, command: List[str], fds=(), env=None,
                 orders: bool = True) -> None:
        self.name = name
        self._log = os.path.join(stage.directory, '%s.log' % name.replace('/', '_'))
        with open(self._log, 'ab') as log:
            pipe = subprocess.PIPE if orders else None
            self.process = subprocess.Popen(
                command, stdin=pipe if orders else subprocess.DEVNULL, stdout=pipe or log,
                stderr=log, pass_fds=fds, env=dict(stage.env, **(env or {})),
                start_new_session=True, preexec_fn=_end_with_parent, universal_newlines=True,
                bufsize=1)
        self._orders = orders
        self._introduced = not orders

    @property
    def pid(self) -> int:
        return self.process.pid

    def tell(self, do: str, **arguments) -> None:
        """Give an order."""
        self._introduce()
        try:
            self.process.stdin.write(json.dumps(dict(arguments, do=do)) + '\n')
            self.process.stdin.flush()
        except OSError:
            raise self._fault() from None

    def answer(self) -> Any:
        """Of the order before."""
        if not select.select([self.process.stdout], [], [], _ANSWER)[0]:
            raise BenchError('%s does not answer: %s' % (self.name, self.log_tail()))
        line = self.process.stdout.readline()
        if not line:
            raise self._fault()
        return json.loads(line)

    def ask(self, do: str, **arguments) -> Any:
        """`tell` and `answer`."""
        self.tell(do, **arguments)
        return self.answer()

    def _introduce(self) -> None:
        if not self._introduced:
            self._introduced = True
            self.answer()

    def _fault(self) -> BenchError:
        return BenchError('%s has ended: %s' % (self.name, self.log_tail() or 'without a word'))

    def log_tail(self) -> str:
        """What it said last."""
        with open(self._log, errors='replace') as log:
            return log.read()[-1500:].strip()

    def stop(self) -> None:
        """Begin to end it."""
        if self.process.poll() is None:
            if self._orders:
                self.process.stdin.close()
            else:
                self.process.send_signal(signal.SIGINT)

    def join(self, seconds: float) -> None:
        """Wait for its end; force it after `seconds`."""
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream and not stream.closed:
                stream.close()

    # -- what it costs --------------------------------------------------------------------

    def cpu_seconds(self) -> float:
        """User and system time of all its threads so far."""
        try:
            # The process's CPU clock: /proc/PID/stat's sum, in ns instead of ticks of 10 ms.
            return time.clock_gettime((~self.pid << 3) | 2)
        except OSError:
            with open('/proc/%d/stat' % self.pid) as stat:
                fields = stat.read().rpartition(')')[2].split()
            return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def memory(self) -> Dict[str, float]:
        """Resident now and at most, MB."""
        with open('/proc/%d/status' % self.pid) as status:
            values = dict(line.split(':', 1) for line in status)
        return {'MB': int(values['VmRSS'].split()[0]) / 1024,
                'most MB': int(values['VmHWM'].split()[0]) / 1024}


class Stage:
    """A roscore and a folder for logs."""

    def __init__(self) -> None:
        self.directory = tempfile.mkdtemp(prefix='serial_communication_bench_')
        with socket.socket() as free:
            free.bind(('127.0.0.1', 0))
            port = free.getsockname()[1]
        self.env = {key: value for key, value in os.environ.items()
                    if key not in ('ROS_IP', 'ROS_NAMESPACE')}
        self.env.update(ROS_MASTER_URI='http://127.0.0.1:%d' % port, ROS_HOSTNAME='127.0.0.1',
                        ROS_LOG_DIR=self.directory, ROS_HOME=self.directory,
                        PYTHONUNBUFFERED='1')
        os.environ.update(self.env)      # for the master's and the nodes' APIs
        self._children: List[Child] = []
        self._fds: List[int] = []
        self._core: Optional[Child] = None
        self._port = port

    def __enter__(self) -> 'Stage':
        self._core = Child(self, 'roscore', ['roscore', '-p', str(self._port)], orders=False)
        master = rosgraph.Master('/bench')
        deadline = time.monotonic() + _START
        while True:
            try:
                master.getPid()
                return self
            except (OSError, rosgraph.MasterException):
                if self._core.process.poll() is not None or time.monotonic() > deadline:
                    text = self._core.log_tail()
                    self.__exit__()
                    raise BenchError('roscore does not start: %s' % text) from None
                time.sleep(0.05)

    def __exit__(self, *_) -> None:
        self.clear()
        if self._core:
            self._core.stop()
            self._core.join(10.0)
        shutil.rmtree(self.directory, ignore_errors=True)

    def clear(self) -> None:
        """End every child but the roscore."""
        # Callers and subscribers first: a node that goes before them makes them complain.
        for child in reversed(self._children):
            child.stop()
        for child in self._children:
            child.join(4.0)
        self._children.clear()
        while self._fds:
            os.close(self._fds.pop())

    # -- children -------------------------------------------------------------------------

    def child(self, name: str, module: str, *arguments, fds=(), namespace: str = '') -> Child:
        """A module of the bench that takes orders."""
        command = [sys.executable, '-m', '%s.%s' % (__package__, module)]
        return self._add(Child(self, name, command + list(map(str, arguments)), fds,
                               {'ROS_NAMESPACE': namespace} if namespace else None))

    def bridge(self, namespace: str, ports: Dict[str, str], **parameters) -> Child:
        """The node with these ports; parameters with two underscores for a slash.

        Its /diagnostics stand in its namespace, so that they have subscribers of their own.
        """
        try:
            # Of a bridge that was here before: the parameter server forgets nothing.
            rosgraph.Master('/bench').deleteParam(namespace + '/serial_communication')
        except rosgraph.MasterException:
            pass
        command = [sys.executable, '-c', 'from serial_communication.ros.node import main; main()',
                   '__name:=serial_communication', '/diagnostics:=%s/diagnostics' % namespace]
        command += ['_%s/port:=%s' % port for port in ports.items()]
        command += ['_%s:=%s' % (name.replace('__', '/'), value)
                    for name, value in parameters.items()]
        return self._add(Child(self, 'bridge ' + namespace, command,
                               env={'ROS_NAMESPACE': namespace}, orders=False))

    def busy(self) -> Child:
        """A process that takes all the CPU it gets."""
        return self._add(Child(self, 'busy', [sys.executable, '-c', 'while True: pass'],
                               orders=False))

    def end(self, *children: Child) -> None:
        """End some of them early."""
        for child in children:
            child.stop()
        for child in children:
            child.join(4.0)
            self._children.remove(child)

    def _add(self, child: Child) -> Child:
        self._children.append(child)
        return child

    def pty(self) -> Tuple[int, str]:
        """A raw pty: (master's descriptor, slave's name). Both live as long as the scene."""
        master, slave = pty.openpty()
        tty.setraw(slave)
        self._fds += [master, slave]
        return master, os.ttyname(slave)

    def boards(self, links=LINKS) -> 'Boards':
        """Ptys and the boards behind them."""
        return Boards(self, links)

    def check(self, *children: Child) -> None:
        """BenchError if one of them has ended."""
        for child in children:
            if child.process.poll() is not None:
                raise BenchError('%s has ended: %s' % (child.name, child.log_tail()))


class Boards:
    """The boards of one node: `ports` for it, `talkers`, `listener` and `bus` to order about."""

    def __init__(self, stage: Stage, links) -> None:
        self.ports: Dict[str, str] = {}
        self.talkers: Dict[str, Child] = {}
        for link in links:
            master, self.ports[link] = stage.pty()
            if link == 'bus':
                self.bus = stage.child('bus board', 'boards', 'bus', master, fds=(master,))
                continue
            self.talkers[link] = stage.child(link + ' board', 'boards', 'talker', master,
                                             link, fds=(master,))
            if link == 'arduino':
                self.listener = stage.child('listener', 'boards', 'listener', master,
                                            fds=(master,))

    def talk(self, rates: Dict[str, float], seconds: float) -> Dict[str, list]:
        """All at once, for so long; what they sent, by name."""
        for link, rate in rates.items():
            self.talkers[link].tell('talk', rate=rate, seconds=seconds)
        sent: Dict[str, list] = {}
        for link in rates:
            sent.update(self.talkers[link].answer())
        return sent


def wait_for(condition, what: str, seconds: float = _START) -> None:
    """Until condition() is empty; BenchError with what it is last."""
    deadline = time.monotonic() + seconds
    while True:
        missing = condition()
        if not missing:
            return
        if time.monotonic() > deadline:
            raise BenchError('%s: still waiting for %s' % (what, missing))
        time.sleep(0.1)


def machine() -> Dict[str, Any]:
    """What the figures were measured on."""
    model = ''
    try:
        with open('/proc/cpuinfo') as info:
            model = next((line.split(':', 1)[1].strip() for line in info
                          if line.startswith('model name')), '')
    except OSError:
        pass
    try:
        import rospkg
        rospy_version = rospkg.RosPack().get_manifest('rospy').version
    except Exception:  # pylint: disable=broad-except
        rospy_version = 'unknown'
    return {'cores': len(os.sched_getaffinity(0)), 'processor': model or platform.machine(),
            'kernel': platform.release(), 'python': platform.python_version(),
            'rospy': rospy_version, 'real-time priority': _realtime(),
            'load before': round(os.getloadavg()[0], 2)}


def stolen() -> Tuple[float, float]:
    """CPU time that a host took from this virtual machine, and all CPU time; in ticks."""
    with open('/proc/stat') as stat:
        ticks = [float(field) for field in stat.readline().split()[1:9]]
    return ticks[7], sum(ticks)


def _realtime() -> bool:
    """Whether a process may ask for it here."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *before)
        return True
    except OSError:
        return False


def _end_with_parent() -> None:
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    except (OSError, AttributeError):
        pass
