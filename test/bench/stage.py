"""What the bench has beside the roscore and nodes: ptys, children that take orders, the machine."""
import json
import os
import platform
import pty
import select
import signal
import subprocess
import sys
import tty
from typing import Any, Dict, List, Tuple

from processes import Child, Stage
from .boards import LINKS

_ANSWER = 300.0   # s that an order may take


class Servant(Child):
    """A process that takes orders and answers them; see child.py."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, orders=True, stdout=subprocess.PIPE, **options)
        self._introduced = False

    def tell(self, do: str, **arguments: Any) -> None:
        """Give an order."""
        if not self._introduced:
            self._introduced = True
            self.answer()
        self.order(json.dumps(dict(arguments, do=do)))

    def answer(self) -> Any:
        """Of the order before."""
        if not select.select([self.process.stdout], [], [], _ANSWER)[0]:
            raise self.fault()
        line = self.process.stdout.readline()
        if not line:
            raise self.fault()
        return json.loads(line)

    def ask(self, do: str, **arguments: Any) -> Any:
        """`tell` and `answer`."""
        self.tell(do, **arguments)
        return self.answer()

    def ask_to_end(self, number: int = signal.SIGTERM) -> None:
        """By the end of its orders."""
        try:
            self.process.stdin.close()
        except OSError:
            pass


class BenchStage(Stage):
    """One scene after the other; what a scene has ends with `clear`."""

    def __init__(self) -> None:
        super().__init__('serial_communication_bench_')
        self._fds: List[int] = []

    def __exit__(self, *_: Any) -> None:
        super().__exit__()
        self.discard()

    def clear(self) -> None:
        super().clear()
        while self._fds:
            os.close(self._fds.pop())

    def servant(self, name: str, module: str, *arguments: Any, **options: Any) -> Servant:
        """A module of the bench that takes orders."""
        command = [sys.executable, '-m', f'{__package__}.{module}', *map(str, arguments)]
        return self.add(Servant(name, command, self.folder, self._env(options), **options))

    def pty(self) -> Tuple[int, str]:
        """A raw pty: (master's descriptor, slave's name). Both live as long as the scene."""
        master, slave = pty.openpty()
        tty.setraw(slave)
        self._fds += [master, slave]
        return master, os.ttyname(slave)

    def boards(self, links=LINKS) -> 'Boards':
        """Ptys and the boards behind them."""
        return Boards(self, links)


class Boards:
    """The boards of one node: `ports` for it, `talkers`, `listener` and `bus` to order about."""

    def __init__(self, stage: BenchStage, links) -> None:
        self.ports: Dict[str, str] = {}
        self.talkers: Dict[str, Servant] = {}
        for link in links:
            master, self.ports[link] = stage.pty()
            if link == 'bus':
                self.bus = stage.servant('bus board', 'boards', 'bus', master, fds=(master,))
                continue
            self.talkers[link] = stage.servant(link + ' board', 'boards', 'talker', master,
                                               link, fds=(master,))
            if link == 'arduino':
                self.listener = stage.servant('listener', 'boards', 'listener', master,
                                              fds=(master,))

    def talk(self, rates: Dict[str, float], seconds: float) -> Dict[str, list]:
        """All at once, for so long; what they sent, by name."""
        self.start_talking(rates, seconds)
        return self.end_talking(rates)

    def start_talking(self, rates: Dict[str, float], seconds: float) -> None:
        """The first half of `talk`, so that other boards can talk at the same time."""
        for link, rate in rates.items():
            self.talkers[link].tell('talk', rate=rate, seconds=seconds)

    def end_talking(self, rates: Dict[str, float]) -> Dict[str, list]:
        """The second half; what they sent, by name."""
        sent: Dict[str, list] = {}
        for link in rates:
            sent.update(self.talkers[link].answer())
        return sent


def memory(child: Child) -> float:
    """Resident, MB."""
    with open(f'/proc/{child.pid}/status') as status:
        values = dict(line.split(':', 1) for line in status)
    return int(values['VmRSS'].split()[0]) / 1024


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
