"""What the scenarios use: a roscore, the bridge, the lines, the boards and the robot."""
import collections
import contextlib
import json
import signal
import sys
from typing import Any, Callable, Dict, Iterator, List, Tuple

from heartbeats import BEAT_MISSED, longest_gap
from processes import Child, Stage, StageError, has_priority
from .boards import CUSTOM, Board, BusBoard, Car, Sensors
from .lines import Clock, SerialLine
from .logs import LateWakeUps, LogCheck
from .requirements import Requirement, Table
from .robot import TOPICS, Published, Robot

REPLY_TIMEOUT = 0.3      # s: parameters of the bridge
MOTION_TIMEOUT = 0.5
SPEED_TIMEOUT = 0.5
PARAMETERS: Dict[str, Any] = {
    'bus/motion_timeout': MOTION_TIMEOUT, 'bus/reply_timeout': REPLY_TIMEOUT,
    'bus/environment_period': 0.0, **{name: json.dumps(rows) for name, rows in CUSTOM.items()}}
# A car on a pty that sends only what a scenario asks for would be silent, and get no commands.
QUIET_CAR: Dict[str, Any] = {'arduino/network_silence': 0.0}
POLLED_TOPICS = '~environment', '~depth', '~height'

PORT_RETURNS = 'ports', "data within 1.5 s of the port's return"
PORT_RETURN = 1.5        # s
STOP_FIRST = 'motor', 'SPEED 0 is the first packet whenever the port opens'
LATCHED = 'old commands', 'an old latched command is refused, a new one is sent'
ERRORS_COUNTED = 'data', 'every error is counted by cause and costs no valid frame'

QUIET_HEARTBEATS = 20    # heartbeats in a row after which the car's line is quiet
UNTIL_PUBLISHED = 5.0    # s
_ROUNDING = 1e-4         # s, of stamps


class MachineTooBusy(Exception):
    """The bridge got no processor time, so the results prove nothing: repeat the scenario."""


class Rig(Stage):
    """All of it is in this process, except the bridge and the processes of children.py."""

    def __init__(self, table: Table, keep: str = '', bridge: str = '') -> None:
        super().__init__('serial_communication_soak_', keep, bridge)
        self.bridge_command = self._bridge
        self.table = table
        self.require = table.require
        self.clock = Clock()
        self.logs = LogCheck(self.folder, self.require)
        self.bridge_number = 0

    def __enter__(self) -> 'Rig':
        super().__enter__()
        self.robot = Robot()
        self.car_line, self.bus_line, self.mcu_line = (
            SerialLine(self.path(name)) for name in ('arduino', 'bus', 'mcu'))
        self.lines = {'bus': self.bus_line, 'arduino': self.car_line, 'mcu': self.mcu_line}
        self.car = Car(self.car_line)
        self.bus = BusBoard(self.bus_line, self.clock)
        self.sensors = Sensors(self.mcu_line)
        self.sleeper = self.user('sleeper', 'sleeper', ready=False)
        self._late_wake_ups = LateWakeUps(self.sleeper.log)
        return self

    def start(self, parameters: Dict[str, Any] = {}) -> None:
        """Start a bridge with these parameters besides `PARAMETERS`; wait until it works."""
        self.bridge_number += 1
        self._parameters = parameters
        ports = dict(bus=self.bus_line.port, arduino=self.car_line.port, mcu=self.mcu_line.port)
        name = f'bridge_{self.bridge_number}'
        self.child_bridge = self.bridge(
            ports, {**PARAMETERS, **parameters}, name,
            [*self.bridge_command, f'__log:={self.logs.folder}/{name}.log'])
        self.wait_for_bridge()

    def end_bridge(self) -> None:
        self.logs.check_new_lines()
        self.end(self.child_bridge)

    def wait_for_bridge(self) -> None:
        """Until it serves every link that is plugged in, and is connected to the robot."""
        child = self.child_bridge
        topics = set(TOPICS) - set(POLLED_TOPICS[1:])
        self.wait(lambda: not child.alive or self.robot.connected(topics)
                  and (not self.car_line.plugged or self.car.heartbeats > QUIET_HEARTBEATS),
                  'the bridge is up')
        self.check(child)
        self.wait(lambda: self.robot.call('bus/echo').success, 'the bus board is in step')

    def restore(self) -> None:
        """After a scenario that failed: no children, all lines as before, a working bridge."""
        for child in set(self.children) - {self.child_bridge, self.sleeper}:
            self.end(child)
        self.child_bridge.send(signal.SIGCONT)
        self.bus.react, self.bus.in_step = None, True
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
        """Start a process of children.py; wait until it is ready."""
        child = self.child(name, [sys.executable, '-m', __package__ + '.children', role, name,
                                  *map(str, arguments)], orders=True)
        if ready:
            self.wait(lambda: 'ready' in child.tail() or not child.alive, name)
            self.check(child)
        return child

    @contextlib.contextmanager
    def suspended(self) -> Iterator[None]:
        """Suspend the bridge with SIGSTOP, and read what it wrote before; finally SIGCONT."""
        self.child_bridge.hold()
        self.car_line.drain()
        try:
            yield
        finally:
            self.child_bridge.send(signal.SIGCONT)

    def has_priority(self) -> bool:
        return has_priority(self.child_bridge.pid)

    def wait_heartbeats(self, number: int) -> None:
        """Wait for a time that the bridge itself measures."""
        until = self.car.heartbeats + number
        self.wait(lambda: self.car.heartbeats >= until, f'{number} heartbeats')

    def sleep(self, seconds: float) -> None:
        """Wait until `clock` has called all that is due in this time."""
        passed: List[bool] = []
        self.clock.after(seconds, lambda: passed.append(True))
        self.wait(lambda: passed, 'the clock')

    def settle(self) -> None:
        """Wait until nothing is in progress on any line or topic, and clear all records. So all
        that is recorded afterwards is caused by the next event."""
        car, sensors = self.car, self.sensors

        def quiet() -> bool:
            last = car.packets[-1:]
            return not last or last[0].connection < car.connection \
                or car.heartbeats > last[0].heartbeats + QUIET_HEARTBEATS

        def published() -> Any:
            """Publish one value on each topic: earlier values cannot arrive after it."""
            self.clear_records()
            car.measure()
            sensors.measure()
            sensors.cliff()
            with contextlib.suppress(StageError):
                return self.wait(lambda: all(map(self.robot.has, car.sent + sensors.sent)), '', 1.0)

        self.bus.react = None
        self.wait(lambda: self.robot.call('bus/echo').success, 'the bus board is in step')
        self.wait(quiet, "the car's line is quiet")
        self.wait(published, 'measurements are published')
        self.clear_records()
        self._stale_before = self._stale()

    def clear_records(self) -> None:
        for each in (self.car, self.bus, self.sensors, self.robot):
            each.clear_records()

    def _stale(self) -> List[str]:
        """The number of stale bytes that each link has dropped."""
        return [report[3]['stale'] for report in list(self.robot.reports.values())]

    def wait_for_data(self, topic: str, measure: Callable[[], None], required: Requirement) -> None:
        count = len(self.robot.published[topic])

        def is_published() -> bool:
            measure()
            self.wait_heartbeats(2)
            return len(self.robot.published[topic]) > count
        required.wait(is_published, f'{topic} is published')

    @contextlib.contextmanager
    def measuring(self) -> Iterator[None]:
        """The car and the sensor board send measurements meanwhile."""
        active = [True]

        def measure() -> None:
            if active:
                self.car.measure()
                self.sensors.measure()
                self.clock.after(0.05, measure)
        measure()
        try:
            yield
        finally:
            active.clear()
            self.sleep(0.05)        # until the last call of `measure` has returned

    def next_report(self, link: str) -> Tuple[int, str, Dict[str, str]]:
        """Level, message and values of the next status of a link in /diagnostics."""
        before = self.robot.reports.get(link, (0.0,))[0]
        self.wait(lambda: self.robot.reports.get(link, (0.0,))[0] > before, '/diagnostics')
        return self.robot.reports[link][1:]

    @contextlib.contextmanager
    def counted(self, required: Requirement, link: str, wanted: Dict[str, int]) -> Iterator[None]:
        """Check that these counters in /diagnostics grow by exactly these numbers meanwhile."""
        def counters() -> Dict[str, int]:
            values = self.next_report(link)[2]
            return {key: int(values[key]) for key in wanted}
        before = counters()
        yield
        for _ in range(2):      # the next report may be from before the event
            after = counters()
            grown = {key: after[key] - before[key] for key in wanted}
            if grown == wanted:
                break
        required.check(grown == wanted, f'{link}: counted {grown}, expected {wanted}')

    @contextlib.contextmanager
    def traffic(self) -> Iterator[Dict[Tuple[str, int], List[bytes]]]:
        """The frames in serial_msg, by link and direction, as soon as those of each link arrive."""
        frames: Dict[Tuple[str, int], List[bytes]] = collections.defaultdict(list)
        subscriber = self.robot.subscribe_to_traffic(
            lambda message: frames[message.link, message.direction].append(bytes(message.frame)))

        def complete() -> bool:
            self.car.measure()
            self.sensors.measure()
            return self.robot.call('bus/echo').success and len(frames) >= 5
        self.wait(complete, 'serial_msg')
        yield frames
        subscriber.unregister()

    def compare(self, *boards: Board) -> None:
        """Compare what these boards sent since `settle` with what was published, and its stamps."""
        required = self.require('data', 'every valid frame is published once, in order, unchanged')
        for topic, messages in self.robot.published.items():
            wanted = [each for board in boards for each in board.sent if each.topic == topic]

            def published() -> List[Published]:     # without the reports of a silent board
                return [each for each in messages if each.key is not None]
            with contextlib.suppress(StageError):
                self.wait(lambda: len(published()) >= len(wanted), '', UNTIL_PUBLISHED)
            if len(wanted) != len(published()) and self.next_report('mcu') and \
                    self._stale() != self._stale_before:
                raise MachineTooBusy
            required.check(len(wanted) == len(published()),
                           f'{topic}: {len(wanted)} sent, {len(published())} published')
            for sent, message in zip(wanted, published()):
                if not required.check(sent.key == message.key,
                                      f'{topic}: {sent.key} sent, {message.key} published'):
                    break
                self.check_stamp(sent.wall, message, topic)

    def check_stamp(self, written: float, message: Published, topic: str) -> None:
        required = self.require('stamps', "between the frame's write and the message's arrival")
        if message.stamp:
            required.keep_worst((message.stamp - written) * 1e3, 'ms behind the write')
            required.check(written - _ROUNDING <= message.stamp <= message.wall + _ROUNDING,
                           f'{topic} {message.key}: written at {written:.4f}, stamped '
                           f'{message.stamp:.4f}, arrived at {message.wall:.4f}')

    @contextlib.contextmanager
    def no_missed_heartbeat(self) -> Iterator[None]:
        """Check for gaps meanwhile; not decided for a bridge without real-time priority."""
        self.car.heartbeat_times.clear()
        yield
        self.wait_heartbeats(50)    # later ones show which ones were only read late
        times = list(self.car.heartbeat_times)
        gap = longest_gap(times, 100.0)
        required = self.require('heartbeat', 'no gap of 30 ms, whatever else happens')
        if not self.has_priority():
            required.undecided += 1
            return
        if self.was_starved(gap, times[0]):
            raise MachineTooBusy
        required.checks += len(times) - 2
        required.at_most(gap * 1e3, BEAT_MISSED * 1e3, 'ms', 'the longest gap')

    def was_starved(self, gap: float, since: float) -> bool:
        """Whether a heartbeat gap is too long, and the machine woke the sleeper as late."""
        late = self._late_wake_ups.longest(since - 0.1)
        return gap >= BEAT_MISSED and late >= gap - BEAT_MISSED


Scenario = Callable[[Rig], None]
