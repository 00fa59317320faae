"""All that a campaign needs beside its scenarios: a roscore, the bridge, lines, boards, a robot."""
import collections
import contextlib
import json
import os
import signal
import sys
from typing import Any, Callable, Dict, Iterator, List, Tuple

from heartbeats import BEAT_MISSED, longest_gap
from processes import Child, Stage, StageError
from .boards import CUSTOM, Board, BusBoard, Car, Sensors
from .lines import Clock, Line
from .robot import TOPICS, Got, Robot
from .logs import LogWatch
from .rows import Row, Table

REPLY_TIMEOUT = 0.3      # s: parameters of the bridge
MOTION_TIMEOUT = 0.5
SPEED_TIMEOUT = 0.5
PARAMETERS: Dict[str, Any] = {
    'bus/motion_timeout': MOTION_TIMEOUT, 'bus/reply_timeout': REPLY_TIMEOUT,
    'bus/environment_period': 0.0, **{name: json.dumps(rows) for name, rows in CUSTOM.items()}}
RETURN = 1.5             # s from a port's return to data
BACK = 'ports', "data within 1.5 s of the port's return"
FIRST = 'motor', 'at every opening of the port SPEED 0 goes out before any heartbeat'
LATCHED = 'old commands', 'what was latched does not drive; what somebody types now does'
QUIET_BEATS = 20         # heartbeats with nothing else between them: the car's line is quiet
UNTIL_PUBLISHED = 5.0   # s
_SAME_CLOCK = 1e-4       # s; rounding of stamps
POLLED_TOPICS = '~environment', '~depth', '~height'


class Disturbed(Exception):
    """This machine was too busy, so nobody can tell. The scenario is carried out again."""


class Field(Stage):
    """Everything beside the bridge runs in this process, but for users that are stopped."""

    def __init__(self, table: Table, keep: str = '', bridge: str = '') -> None:
        super().__init__('serial_communication_soak_', keep, bridge)
        self.bridge_command = self._bridge
        self.table = table
        self.row = table.row
        self.clock = Clock()
        self.logs = LogWatch(self.folder, self.row)
        self.bridge_number = 0

    def __enter__(self) -> 'Field':
        super().__enter__()
        self.robot = Robot()
        self.car_line, self.bus_line, self.mcu_line = (
            Line(self.path(name)) for name in ('arduino', 'bus', 'mcu'))
        self.lines = {'bus': self.bus_line, 'arduino': self.car_line, 'mcu': self.mcu_line}
        self.car = Car(self.car_line)
        self.bus = BusBoard(self.bus_line, self.clock)
        self.sensors = Sensors(self.mcu_line)
        self.witness = self.user('witness', 'witness', ready=False)
        return self

    def start(self, parameters: Dict[str, Any] = {}) -> None:
        """A bridge, with these beside `PARAMETERS`; returns when it serves every link."""
        self.bridge_number += 1
        self._parameters = parameters
        ports = {'bus': self.bus_line.port, 'arduino': self.car_line.port,
                 'mcu': self.mcu_line.port}
        name = f'bridge_{self.bridge_number}'
        self.child_bridge = self.bridge(
            ports, {**PARAMETERS, **parameters}, name,
            [*self.bridge_command, f'__log:={self.logs.folder}/{name}.log'])
        self.wait_for_bridge()

    def clear_bridge(self) -> None:
        self.logs.look()
        self.end(self.child_bridge)

    def wait_for_bridge(self) -> None:
        """Until it serves every link that has a line, and this node."""
        child = self.child_bridge
        topics = set(TOPICS) - set(POLLED_TOPICS[1:])
        self.wait(lambda: not child.alive or self.robot.connected(topics)
                  and (not self.car_line.plugged or self.car.beat > QUIET_BEATS),
                  'the bridge is up')
        self.check(child)
        self.wait(lambda: self.robot.call('bus/echo').success, 'the bus board is in step')

    def mend(self) -> None:
        """After a scenario that was given up: no users, all lines as before, a working bridge."""
        for child in set(self.children) - {self.child_bridge, self.witness}:
            self.end(child)
        self.child_bridge.send(signal.SIGCONT)
        self.bus.rule, self.bus.in_step = None, True
        self.car_line.frozen = False
        for line in self.lines.values():
            if line.plugged:
                line.unplug()
            line.plug()
        try:
            self.wait_for_bridge()
        except StageError:
            self.end(self.child_bridge, signal.SIGKILL)
            self.start(self._parameters)

    def user(self, role: str, name: str, *arguments: Any, ready: bool = True) -> Child:
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
        try:
            return any(os.sched_getscheduler(int(thread)) == os.SCHED_FIFO for thread in
                       os.listdir(f'/proc/{self.child_bridge.pid}/task'))
        except OSError:
            return False

    def beats(self, number: int) -> None:
        """Until so many heartbeats have come: time on the bridge's own clock."""
        until = self.car.beat + number
        self.wait(lambda: self.car.beat >= until, f'{number} heartbeats')

    def let_pass(self, seconds: float) -> None:
        passed: List[bool] = []
        self.clock.after(seconds, lambda: passed.append(True))
        self.wait(lambda: passed, 'the clock')

    def calm(self) -> None:
        """Until nothing is under way: the motor stands, its stop is no longer repeated, the bus is
        in step and silent, and all that was measured has been published. So what comes from now on
        is of the next event."""
        car, sensors = self.car, self.sensors

        def quiet() -> bool:
            last = car.packets[-1:]
            return not last or last[0].connection < car.connection \
                or car.beat > last[0].beat + QUIET_BEATS

        def published() -> Any:
            """What has just been measured: on each topic nothing of before can come behind it."""
            self.forget()
            car.measure()
            sensors.measure()
            sensors.cliff()
            with contextlib.suppress(StageError):
                return self.wait(lambda: all(map(self.robot.has, car.sent + sensors.sent)), '', 1.0)

        self.bus.rule = None
        self.wait(lambda: self.robot.call('bus/echo').success, 'the bus board is in step')
        self.wait(quiet, 'the car stands')
        self.wait(published, 'what is measured is published')
        self.forget()
        self._stale = self._dropped()

    def forget(self) -> None:
        for one in (self.car, self.bus, self.sensors, self.robot):
            one.forget()

    def _dropped(self) -> List[str]:
        """Bytes that each link has dropped as old, since the bridge had no time when they came."""
        return [report[3]['stale'] for report in list(self.robot.diagnostics.values())]

    def flows(self, topic: str, measure: Callable[[], None], row: Row) -> None:
        count = len(self.robot.got[topic])

        def flows() -> bool:
            measure()
            self.beats(2)
            return len(self.robot.got[topic]) > count
        row.wait(flows, f'{topic} is published')

    @contextlib.contextmanager
    def talking(self) -> Iterator[None]:
        talks = [True]

        def talk() -> None:
            if talks:
                self.car.measure()
                self.sensors.measure()
                self.clock.after(0.05, talk)
        talk()
        try:
            yield
        finally:
            talks.clear()
            self.let_pass(0.05)     # by the same clock: none is under way any more

    def diagnosed(self, link: str) -> Tuple[int, str, Dict[str, str]]:
        """The next report on a link: level, text, values."""
        before = self.robot.diagnostics.get(link, (0.0,))[0]
        self.wait(lambda: self.robot.diagnostics.get(link, (0.0,))[0] > before, '/diagnostics')
        return self.robot.diagnostics[link][1:]

    @contextlib.contextmanager
    def counts(self, row: Row, link: str, wanted: Dict[str, int]) -> Iterator[None]:
        """By what happens meanwhile, these counters of /diagnostics grow exactly so."""
        def counters() -> Dict[str, int]:
            values = self.diagnosed(link)[2]
            return {key: int(values[key]) for key in wanted}
        before = counters()
        yield
        for _ in range(2):      # a report may be of just before
            after = counters()
            grown = {key: after[key] - before[key] for key in wanted}
            if grown == wanted:
                break
        row.check(grown == wanted, f'{link}: {grown} counted, {wanted} there were')

    @contextlib.contextmanager
    def traffic(self) -> Iterator[Dict[Tuple[str, int], List[bytes]]]:
        """The frames that serial_msg shows, by link and direction, from now on of every link."""
        shown: Dict[Tuple[str, int], List[bytes]] = collections.defaultdict(list)
        self.robot.on_frame = lambda message: shown[message.link, message.direction].append(
            bytes(message.frame))
        self.robot.listen_to_traffic()

        def begun() -> bool:
            self.car.measure()
            self.sensors.measure()
            return self.robot.call('bus/echo').success and len(shown) >= 5
        self.wait(begun, 'serial_msg')
        yield shown
        self.robot.listen_to_traffic(False)

    def compare(self, *boards: Board) -> None:
        """What was published since the last calm is what these boards sent: each once, in order;
        each stamp lies between the write of its frame and the arrival of its message."""
        row = self.row('data', 'every valid frame is published once, in order, with its values')
        for topic, messages in self.robot.got.items():
            wanted = [one for board in boards for one in board.sent if one.topic == topic]

            def got() -> List[Got]:     # without the reports of silence
                return [one for one in messages if one.key is not None]
            with contextlib.suppress(StageError):
                self.wait(lambda: len(got()) >= len(wanted), '', UNTIL_PUBLISHED)
            if len(wanted) != len(got()) and self.diagnosed('mcu') and \
                    self._dropped() != self._stale:
                raise Disturbed
            row.check(len(wanted) == len(got()),
                      f'{topic}: {len(wanted)} sent, {len(got())} published')
            for one, message in zip(wanted, got()):
                if not row.check(one.key == message.key,
                                 f'{topic}: {one.key} was sent, {message.key} published'):
                    break
                self.judge_stamp(one.wall, message, topic)

    def judge_stamp(self, written: float, message: Got, topic: str) -> None:
        row = self.row('stamps', 'between the write of the frame and the arrival of the message')
        if message.stamp:
            row.note((message.stamp - written) * 1e3, 'ms behind the write')
            row.check(written - _SAME_CLOCK <= message.stamp <= message.wall + _SAME_CLOCK,
                      f'{topic} {message.key}: written at {written:.4f}, stamped '
                      f'{message.stamp:.4f}, arrived at {message.wall:.4f}')

    @contextlib.contextmanager
    def heartbeats(self) -> Iterator[None]:
        """No heartbeat is missed meanwhile, and the line is not touched. For a bridge that may
        have real-time priority: to others nothing is promised."""
        self.car.beats.clear()
        yield
        self.beats(50)      # those behind tell which of the others were only read late
        stamps = list(self.car.beats)
        gap = longest_gap(stamps, 100.0)
        if not self.has_priority():
            return
        if self.was_starved(gap, stamps[0]):
            raise Disturbed
        row = self.row('heartbeat', 'no gap of 30 ms, whatever happens beside the open port')
        row.tries += len(stamps) - 2
        row.at_most(gap * 1e3, BEAT_MISSED * 1e3, 'ms', 'the longest gap')

    def was_starved(self, gap: float, since: float) -> bool:
        """Whether this machine may have made a gap too long: it was as late to wake a process that
        only sleeps."""
        with open(self.witness.log) as file:
            late = [line.split() for line in file if line.endswith('\n')]
        waits = [float(wait) for when, wait in late if float(when) >= since - 0.1]
        return gap >= BEAT_MISSED and max(waits, default=0.0) >= gap - BEAT_MISSED


Scenario = Callable[[Field], None]
