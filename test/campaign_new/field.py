"""All that a campaign needs beside its scenarios: a roscore, the bridge, lines, boards, a robot."""
import contextlib
import json
import os
import signal
import sys
from typing import Any, Callable, Dict, Iterable, Iterator, List

import psutil

from heartbeats import longest_gap
from processes import Child, Stage, StageError
from .boards import CUSTOM, Board, BusBoard, Car, Sensors
from .lines import Clock, Line
from .robot import TOPICS, Got, Robot
from .rows import Row, Table

REPLY_TIMEOUT = 0.3      # s: parameters of the bridge
MOTION_TIMEOUT = 0.5
SPEED_TIMEOUT = 0.5
PARAMETERS: Dict[str, Any] = {
    'bus/motion_timeout': MOTION_TIMEOUT, 'bus/reply_timeout': REPLY_TIMEOUT,
    'bus/environment_period': 0.0, **{name: json.dumps(rows) for name, rows in CUSTOM.items()}}
RETURN = 1.5             # s from a port's return to data
QUIET_BEATS = 20         # heartbeats with nothing else between them: the car's line is quiet
PATIENCE = 30.0          # s for what has no limit of its own; waited out only if it never comes
_UNTIL_PUBLISHED = 5.0   # s
_SAME_CLOCK = 1e-4       # s; rounding of stamps
POLLED_TOPICS = '~environment', '~depth', '~height'


class Field(Stage):
    """Everything beside the bridge runs in this process, but for users that are stopped."""

    def __init__(self, table: Table, keep: str = '', bridge: str = '') -> None:
        super().__init__('serial_communication_soak_', keep, bridge)
        self.table = table
        self.clock = Clock()
        self.bridge_number = 0

    @property
    def bridge_command(self) -> List[str]:
        """What starts one."""
        return self._bridge

    def __enter__(self) -> 'Field':
        super().__enter__()
        self.robot = Robot()
        self.car_line, self.bus_line, self.mcu_line = (
            Line(self.path(name)) for name in ('arduino', 'bus', 'mcu'))
        self.lines = {'bus': self.bus_line, 'arduino': self.car_line, 'mcu': self.mcu_line}
        self.car = Car(self.car_line)
        self.bus = BusBoard(self.bus_line, self.clock)
        self.sensors = Sensors(self.mcu_line)
        return self

    def row(self, group: str, promise: str) -> Row:
        """The table's."""
        return self.table.row(group, promise)

    # -- processes ----------------------------------------------------------------------

    def start(self, parameters: Dict[str, Any] = {}, **ports: str) -> None:
        """A bridge; returns when it serves every link.

        Args:
            parameters: beside `PARAMETERS`.
            ports: instead of those of the lines.
        """
        self.bridge_number += 1
        self._started = parameters, ports
        wanted = {link: ports.get(link, line.port) for link, line in self.lines.items()}
        self.child_bridge = self.bridge(wanted, {**PARAMETERS, **parameters},
                                        f'bridge {self.bridge_number}')
        self.wait_for_bridge()

    def clear_bridge(self) -> None:
        """None runs any more."""
        if self.child_bridge in self.children:
            self.end(self.child_bridge)

    def wait_for_bridge(self) -> None:
        """Until it serves every link that has a line, and this node."""
        child = self.child_bridge
        topics = set(TOPICS) - set(POLLED_TOPICS[1:])
        self.wait(lambda: not child.alive or self.robot.connected and self.robot.hears(topics)
                  and (not self.car_line.plugged or self.car.beat > QUIET_BEATS),
                  'the bridge is up')
        self.check(child)
        self.wait(lambda: self.robot.call('bus/echo').success, 'the bus board is in step')

    def mend(self) -> None:
        """After a scenario that was given up: no users, all lines as before, a working bridge."""
        for child in [child for child in self.children if child is not self.child_bridge]:
            self.end(child)
        self.child_bridge.send(signal.SIGCONT)
        self.bus.rule, self.bus.echoes = None, True
        self.car_line.frozen = False
        for line in self.lines.values():
            if line.plugged:
                line.unplug()
            line.plug()
        try:
            self.wait_for_bridge()
        except StageError:
            parameters, ports = self._started
            self.end(self.child_bridge, signal.SIGKILL)
            self.start(parameters, **ports)

    def user(self, role: str, name: str, *arguments: Any, ready: bool = True) -> Child:
        """A process of children.py."""
        child = self.child(name, [sys.executable, '-m', __package__ + '.children', role, name,
                                  *map(str, arguments)], orders=True)
        if ready:
            self.wait(lambda: 'ready' in child.tail() or not child.alive, name)
            self.check(child)
        return child

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """The bridge does nothing meanwhile: SIGSTOP and SIGCONT. What it wrote before is read."""
        self.child_bridge.hold()
        self.car_line.drain()
        try:
            yield
        finally:
            self.child_bridge.send(signal.SIGCONT)

    def has_priority(self) -> bool:
        """Whether the bridge's heartbeat has real-time priority."""
        try:
            return any(os.sched_getscheduler(int(thread)) == os.SCHED_FIFO for thread in
                       os.listdir(f'/proc/{self.child_bridge.pid}/task'))
        except OSError:
            return False

    def usage(self) -> Dict[str, float]:
        """Of the bridge: resident MB, threads, open files."""
        return usage_of(self.child_bridge.pid)

    # -- waiting ------------------------------------------------------------------------

    def beats(self, number: int) -> None:
        """Until so many heartbeats have come: time on the bridge's own clock."""
        until = self.car.beat + number
        self.wait(lambda: self.car.beat >= until, f'{number} heartbeats', PATIENCE)

    def let_pass(self, seconds: float) -> None:
        """Where the time itself is the event."""
        passed: List[bool] = []
        self.clock.after(seconds, lambda: passed.append(True))
        self.wait(lambda: passed, 'the clock')

    def calm(self) -> None:
        """Until nothing is under way: the motor stands, its stop is no longer repeated, the bus is
        in step and silent. So what comes from now on is of the next event."""
        def quiet() -> bool:
            last = self.car.packets[-1:]
            return not last or (last[0].connection, last[0].beat + QUIET_BEATS) < (
                self.car.connection, self.car.beat) or \
                self.car.beat - last[0].beat > QUIET_BEATS
        self.bus.rule = None
        self.wait(lambda: self.robot.call('bus/echo').success, 'the bus board is in step')
        self.wait(quiet, 'the car stands', PATIENCE)
        self.car.packets.clear()
        self.bus.requests.clear()
        self.bus.executed.clear()
        for board in (self.car, self.bus, self.sensors):
            board.forget()
        for messages in self.robot.got.values():
            messages.clear()

    def flows(self, topic: str, measure: Callable[[], None], row: Row) -> None:
        """Until what is measured is published again."""
        count = len(self.robot.got[topic])

        def flows() -> bool:
            measure()
            self.beats(2)
            return len(self.robot.got[topic]) > count
        row.wait(flows, PATIENCE, f'{topic} is published')

    @contextlib.contextmanager
    def talking(self) -> Iterator[None]:
        """The boards measure all the time."""
        talks = [True]

        def talk() -> None:
            self.car.measure()
            self.sensors.measure()
            if talks:
                self.clock.after(0.05, talk)
        talk()
        yield
        talks.clear()

    def diagnosed(self, link: str, key: str = '') -> Any:
        """The next report on a link: (level, text), or the number of one key."""
        before = self.robot.diagnostics.get(link, (0.0,))[0]
        self.wait(lambda: self.robot.diagnostics.get(link, (0.0,))[0] > before, '/diagnostics')
        _time, level, text, values = self.robot.diagnostics[link]
        return int(values[key]) if key else (level, text)

    # -- exact comparisons ----------------------------------------------------------------

    def compare(self, *boards: Board) -> None:
        """What was published since the last calm is what these boards sent: each once, in order;
        each stamp lies between the write of its frame and the arrival of its message."""
        row = self.row('data', 'every valid frame is published once, in order, with its values')
        for topic, messages in self.robot.got.items():
            wanted = [one for board in boards for one in board.sent if one.topic == topic]
            with contextlib.suppress(StageError):
                self.wait(lambda: len(of_boards(messages)) >= len(wanted), '', _UNTIL_PUBLISHED)
            got = of_boards(messages)
            for one, message in zip(wanted, got):
                if not row.check(one.key == message.key, f'{topic}: {one.key} was sent, '
                                 f'{message.key} published ({len(wanted)} and {len(got)} in all)'):
                    break
                self.judge_stamp(one.wall, message, topic)
            row.check(len(wanted) == len(got), f'{topic}: {len(wanted)} sent, {len(got)} published')

    def judge_stamp(self, written: float, message: Got, topic: str) -> None:
        """Of a frame that was written at that time."""
        row = self.row('stamps', 'between the write of the frame and the arrival of the message')
        if message.stamp:
            row.note((message.stamp - written) * 1e3, 'ms behind the write')
            row.check(written - _SAME_CLOCK <= message.stamp <= message.wall + _SAME_CLOCK,
                      f'{topic} {message.key}: written at {written:.4f}, stamped '
                      f'{message.stamp:.4f}, arrived at {message.wall:.4f}')

    @contextlib.contextmanager
    def heartbeats(self) -> Iterator[None]:
        """No heartbeat is missed meanwhile, and the line is not touched."""
        row = self.row('heartbeat', 'no gap of 30 ms, whatever happens beside the open port')
        first = self.car.beat
        self.car.beats.clear()
        gaps: List[float] = []
        done: List[bool] = []

        def look() -> None:
            stamps = list(self.car.beats)
            if len(stamps) > 100:
                gaps.append(longest_gap(stamps, 100.0))
                while len(self.car.beats) > 1 and self.car.beats[0] < stamps[-1]:
                    self.car.beats.popleft()
            if not done:
                self.clock.after(0.5, look)

        self.clock.after(0.5, look)
        yield
        done.append(True)
        stamps = list(self.car.beats)
        gaps += [longest_gap(stamps, 100.0)] if len(stamps) > 1 else []
        row.tries += max(0, self.car.beat - first - 1)
        row.at_most(max(gaps, default=0.0) * 1e3, 30.0, 'ms', 'the longest gap')


def of_boards(got: Iterable[Got]) -> List[Got]:
    """Without the reports of silence, which no frame is behind."""
    return [one for one in got if one.key is not None]


def usage_of(pid: int) -> Dict[str, float]:
    """Resident MB, threads and open files of a process; empty if it has ended."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            return {'memory': process.memory_info().rss / (1 << 20),
                    'threads': process.num_threads(), 'files': process.num_fds()}
    except (OSError, psutil.Error):
        return {}


Scenario = Callable[[Field], None]
