"""What the scenarios use: a roscore, the bridge, the lines, the boards and the robot."""
import contextlib
import itertools
import json
import math
import signal
import sys
import time
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Tuple

from processes import Child, Stage, StageError
from .witness import LATE
from .boards import BEAT_MISSED, CUSTOM, Board, BusBoard, Car, Sensors, Sent
from .lines import Clock, NetworkLine, SerialLine
from .logs import LogCheck
from .machine import MARGIN, Machine
from .requirements import MAX_WAIT, Requirement, Table
from .robot import FRAMES, GYRO, PREFIX, TOPICS, Published, Robot, other_fields

REPLY_TIMEOUT = 0.3      # s: parameters of the bridge
MOTION_TIMEOUT = SPEED_TIMEOUT = 0.5
MOUNT = 0.1, -0.2, 0.3, 0.1, -0.2, 0.5     # of range_2: x y z, roll pitch yaw
PARAMETERS: Dict[str, Any] = {
    'bus/motion_timeout': MOTION_TIMEOUT, 'bus/reply_timeout': REPLY_TIMEOUT,
    'bus/environment_period': 0.0, 'publish_tf': True, 'mcu/range_2_mount': json.dumps(MOUNT),
    'frame_prefix': PREFIX, 'arduino/gyro_scale': GYRO,
    **{name: json.dumps(rows) for name, rows in CUSTOM.items()}}
POLLED_TOPICS = '~depth', '~height', '~environment', '~environment/temperature', \
    '~environment/humidity'

STOP_FIRST = 'SPEED 0 is the first packet whenever the port opens'
LATCHED = 'an old latched command is refused, a new one is sent'
FENCED = 'a fence, an ECHO with a fresh nonce, precedes every call'
PUBLISHED = 'every valid frame is published once, in order, unchanged'

AFTER = 0.6              # s until a packet that must not arrive would have arrived
UNTIL_PUBLISHED = 5.0    # s
NOISE = bytes(byte for byte in range(256) if byte not in b'\xA5\x5A\x02\x00')[:200]
NAMES = 'bus', 'arduino', 'mcu'      # of the links
_QUIET = 0.2             # s without a packet to the car after which its line is quiet
_ROUNDING = 1e-4         # s, of stamps


class Rig(Stage):
    """All of it is in this process, except the bridge and the processes of children.py."""

    def __init__(self, table: Table, keep: str = '', bridge: str = '') -> None:
        super().__init__('serial_communication_soak_', keep, bridge)
        self.bridge_command = self._bridge
        self.table, self.row = table, table.row
        self.clock = Clock()
        self.logs = LogCheck(self.folder, self.row)
        self.bridge_number, self._numbers = 0, itertools.count()

    def __enter__(self) -> 'Rig':
        super().__enter__()
        self.robot, self.machine = Robot(), Machine()
        self.use_lines({name: SerialLine(self.path(name)) for name in NAMES})
        return self

    def use_lines(self, lines: Dict[str, SerialLine]) -> None:
        """From the next start of a bridge, with new boards at their ends."""
        if hasattr(self, 'car'):
            self.car.talks = False
        self.lines = lines
        self.bus_line, self.car_line, self.mcu_line = (lines[name] for name in NAMES)
        self.is_network = isinstance(self.car_line, NetworkLine)
        self.car, self.bus = Car(self.car_line, self.clock), BusBoard(self.bus_line, self.clock)
        self.sensors = Sensors(self.mcu_line)
        self._checked_beats = 0
        self.bus.check_fence = lambda fence: self.row(FENCED).check(fence.holds, fence.text)
        for line in lines.values():
            if not isinstance(line, NetworkLine):   # a late read there is no stall of the kernel
                line.on_moved = self.machine.moved

    def start(self, parameters: Dict[str, Any] = {}) -> None:
        """Start a bridge with these parameters besides `PARAMETERS`; wait until it works."""
        for board in (self.car, self.bus):      # a pty does not show that the bridge has ended
            board.start_connection()
        self.bridge_number += 1
        self._parameters = parameters
        self.bus.reply_has_cmd2 = parameters.get('bus/reply_has_cmd2', False)
        self.bus.echoes = parameters.get('bus/echo', True)
        ports = {link: line.port for link, line in self.lines.items()}
        self.bridge_name = f'bridge_{self.bridge_number}'
        self.child_bridge = self.bridge(
            ports, {**PARAMETERS, **parameters}, self.bridge_name,
            [*self.bridge_command, f'__log:={self.logs.folder}/{self.bridge_name}.log'])
        self.wait_for_bridge()

    def end_bridge(self) -> None:
        self.end(self.child_bridge)
        self.check_always()

    def check_always(self) -> None:
        """Check what holds at any time: the logs and the heartbeats."""
        self.logs.check_new_lines()
        required = self.row('no gap of 30 ms between heartbeats, whatever else happens')
        required.keep_worst(self.car.longest_gap * 1e3, 'ms')
        required.checks += self.car.all_beats - self._checked_beats
        gaps, self.car.gaps, self._checked_beats = self.car.gaps, [], self.car.all_beats
        for since, until in gaps if self.machine.real_time else ():     # else it is not promised
            self.in_time(required, since, until, BEAT_MISSED, f'at {since:.3f}')

    def in_time(self, required: Requirement, since: float, until: float, limit: float, text: str,
                least: float = -math.inf) -> None:
        """Check the time between two events, in s. It is not decided if a witness was late, too,
        and by as much as the limit was exceeded by, not counting `MARGIN`."""
        seconds = until - since
        excess = max(seconds - limit, least - seconds)
        if excess > 0 and self.machine.late(since, until) >= max(LATE, excess - MARGIN):
            required.undecided += 1
        elif required.check(excess <= 0, f'{text}: {seconds * 1e3:.1f} ms, limit '
                            f'{(limit if seconds > limit else least) * 1e3:g} ms'):
            required.keep_worst(seconds * 1e3, 'ms')

    def wait_for_bridge(self) -> None:
        """Until it serves every link that is plugged in, and is connected to the robot."""
        child = self.child_bridge
        self.wait(lambda: not child.alive or self.robot.connected
                  and (not self.car_line.plugged or self.car.beats > 20), 'the bridge is up')
        self.check(child)
        self.wait_in_step()

    def wait_in_step(self) -> None:
        self.wait(lambda: self.robot.call('bus/echo').success, 'the bus board is in step')

    def restore(self) -> None:
        """After a scenario that failed: a master, no children, lines as before, another bridge."""
        self.child_bridge.send(signal.SIGKILL)
        self.clear()
        if not self.master_runs:
            self.start_master()
            self.robot.register_again()
        self.bus.usual()
        self.car.talks = True
        for line in self.lines.values():
            line.frozen = False
            if line.plugged:
                line.unplug()
            line.plug()
        self.start(self._parameters)

    def user(self, role: str, name: str, *arguments: Any) -> Child:
        """Start a process of children.py; wait until it is ready."""
        child = self.child(f'{name}_{next(self._numbers)}', [
            sys.executable, '-m', __package__ + '.children', role, name, *map(str, arguments)],
                           orders=True)
        self.wait(lambda: 'ready' in child.tail() or not child.alive, name)
        self.check(child)
        return child

    @contextlib.contextmanager
    def suspended(self) -> Iterator[float]:
        """Suspend the bridge with SIGSTOP, and read what it wrote before; finally SIGCONT.

        Yields when it was suspended. The car gives no sign of life meanwhile."""
        self.car.quiet_until = float('inf')
        self._wait_for_beat(0.02)   # so that the bridge has read all of it
        self.child_bridge.hold()
        held_at = time.monotonic()
        self.car_line.drain()
        self.car.forget_beat()
        try:
            yield held_at
        finally:
            self.child_bridge.send(signal.SIGCONT)
            # Until the bridge has dropped what waited meanwhile.
            self.car.quiet_until = time.monotonic() + 0.8

    def wait_beats(self, seconds: float, since: float = 0.0) -> None:
        """Wait so long, or so long since then, and for a heartbeat that the bridge wrote later and
        what it wrote before that, however long the kernel delays them."""
        until = (since or time.monotonic()) + seconds
        self.sleep(until - time.monotonic())
        self.wait(lambda: self.car.beat_at > until or not self.car_line.plugged, 'a heartbeat')

    def _wait_for_beat(self, seconds: float) -> None:
        """Wait so long, and then for a heartbeat, so that the next one is not about to be written:
        if the bridge is suspended just then, it is sent before SPEED 0."""
        until = time.monotonic() + seconds
        while time.monotonic() < until or (self.car.beat_at < until and self.car_line.plugged
                                           and time.monotonic() < until + BEAT_MISSED):
            time.sleep(0.001)

    def sleep(self, seconds: float) -> None:
        """Wait until `clock` has called all that is due in this time."""
        passed: List[bool] = []
        self.clock.after(seconds, lambda: passed.append(True))
        self.wait(lambda: passed, 'the clock')

    def settle(self) -> None:
        """Wait until nothing is in progress on any line or topic, and clear all records. So all
        that is recorded afterwards is caused by the next event."""
        self.bus.usual()
        self.wait_in_step()
        self.wait(lambda: not self.car.packets
                  or time.monotonic() > self.car.packets[-1].t + _QUIET, "the car's line is quiet")
        self.row(PUBLISHED).wait(self._passes_values, 'measurements are published')
        self.clear_records()

    def tries(self, *values: Any) -> Iterator:
        """The values for tries; settles before each."""
        for value in values:
            self.settle()
            yield value

    def _passes_values(self) -> Any:
        """Send a value for each topic: when it is published, no earlier one can be any more."""
        self.clear_records()
        self.measure()
        self.sensors.cliff()
        with contextlib.suppress(StageError):
            return self.wait(lambda: all(map(self.robot.has, self.car.sent + self.sensors.sent)),
                             '', 1.0)

    def clear_records(self) -> None:
        for each in (self.car, self.bus, self.sensors, self.robot):
            each.clear_records()

    def measure(self) -> None:
        """Let the car and the sensor board send their measurements."""
        self.car.measure()
        self.sensors.measure()

    def until_published(self, condition: Callable[[], Any]) -> None:
        """Wait for all that was sent, but not for ever: the caller finds what is missing."""
        with contextlib.suppress(StageError):
            self.wait(condition, '', UNTIL_PUBLISHED)

    def wait_for_data(self, topic: str, measure: Callable[[], None], required: Requirement,
                      seconds: float = MAX_WAIT) -> None:
        count = len(self.robot.published[topic])
        required.wait(lambda: measure() or self.wait_beats(0.02) or len(
            self.robot.published[topic]) > count, f'{topic} is published', seconds)

    def next_report(self, link: str) -> Tuple[int, str, Dict[str, str]]:
        """Level, message and values of the next status of a link in /diagnostics."""
        before = self._reported_at(link)
        self.wait(lambda: self._reported_at(link) > before, '/diagnostics')
        return self.robot.reports[link][-1][1:]

    def _reported_at(self, link: str) -> float:
        reports = self.robot.reports[link]
        return reports[-1][0] if reports else 0.0

    def diagnosed(self, link: str, level: int, words: str, since: Optional[float] = None) -> None:
        """Check that /diagnostics shows this level and these words for a link: soon, or since this
        time."""
        begin = self._reported_at(link) if since is None else since
        self.row('level and words in /diagnostics are true').wait(
            lambda: any(at > begin and found == level and words in text
                        for at, found, text, _values in list(self.robot.reports[link])),
            f'/diagnostics: {link} has level {level} and says "{words}"', 6.0)

    @contextlib.contextmanager
    def counted(self, required: Requirement, link: str, wanted: Dict[str, int]) -> Iterator[float]:
        """Check that these counters in /diagnostics grow by exactly these numbers meanwhile. It
        begins just after a report, at the time that it returns."""
        before = self.next_report(link)[2]
        yield self._reported_at(link)
        for _ in range(2):      # the next report may be from before the event
            after = self.next_report(link)[2]
            grown = {key: int(after[key]) - int(before[key]) for key in wanted}
            if grown == wanted:
                break
        required.check(grown == wanted, f'{link}: counted {grown}, expected {wanted}')

    def compare(self, *boards: Board) -> None:
        """Compare what these boards sent since `settle` with what was published, and its stamps."""
        sent = {topic: [each for board in boards for each in board.sent if each.topic == topic]
                for topic in TOPICS}
        self.until_published(lambda: all(
            len(self.robot.values(topic)) >= len(sent[topic]) for topic in TOPICS))
        for topic in TOPICS:
            self._compare(topic, sent[topic])

    def _compare(self, topic: str, sent: Sequence[Sent]) -> None:
        required = self.row(PUBLISHED)
        for one, message in itertools.zip_longest(sent, self.robot.values(topic)):
            if not required.check(one and message and one.key == message.key,
                                  f'{topic}: {one} sent, {message} published'):
                return
            self.check_stamp(one.wall, message, topic)
            wrong = other_fields(topic, message.message)
            required.check(not wrong, wrong)
            if topic in FRAMES:
                frame = message.message.header.frame_id
                required.check(frame == FRAMES[topic], f'{topic} has the frame {frame}')

    def check_stamp(self, written: float, message: Published, topic: str) -> None:
        required = self.row("between the frame's write and the message's arrival")
        if message.stamp:
            required.keep_worst((message.stamp - written) * 1e3, 'ms behind the write')
            required.check(written - _ROUNDING <= message.stamp <= message.wall + _ROUNDING,
                           f'{topic} {message.key}: written at {written:.4f}, stamped '
                           f'{message.stamp:.4f}, arrived at {message.wall:.4f}')


Scenario = Callable[[Rig], None]
