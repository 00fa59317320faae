"""What the storm uses: a roscore, the bridge, the lines, the boards and the robot."""
import contextlib
import json
import re
import signal
import sys
import time
from pathlib import Path
from typing import Any, Dict, Iterator, Set

import by_definition as codec
from bench.processes import Child, Stage
from .boards import BEAT_MISSED, CUSTOM, PERIODS, BusBoard, Car, Sensors
from .lines import Clock, NetworkLine, SerialLine
from .machine import MARGIN, Machine
from .requirements import Requirement, Table
from .robot import TOPICS, Robot
from .witness import LATE

REPLY_TIMEOUT = 0.3      # s: parameters of the bridge
MOTION_TIMEOUT = SPEED_TIMEOUT = 0.5
PARAMETERS: Dict[str, Any] = {
    'bus/motion_timeout': MOTION_TIMEOUT, 'bus/reply_timeout': REPLY_TIMEOUT,
    'bus/environment_period': PERIODS[codec.ENVIRONMENT], 'bus/announcements': True,
    **{name: json.dumps(rows) for name, rows in CUSTOM.items()}}
POLLED_TOPICS = '~depth', '~height', '~environment', '~environment/temperature', \
    '~environment/humidity'

FENCED = 'a fence, an ECHO with a fresh nonce, precedes every call'

NAMES = 'bus', 'arduino', 'mcu'      # of the links
_QUIET = 0.5             # s after which the last of these values has arrived


class Rig(Stage):
    """All of it is in this process, except the bridge and the slow subscriber."""

    def __init__(self, table: Table, keep: str = '') -> None:
        super().__init__('serial_communication_soak_', keep)
        self.table, self.row = table, table.row
        self.clock = Clock()
        self.bridge_number = 0

    def __enter__(self) -> 'Rig':
        super().__enter__()
        self.robot, self.machine = Robot(), Machine()
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

    def start(self) -> None:
        """Start a bridge; wait until it works."""
        for board in (self.car, self.bus):      # a pty does not show that the bridge has ended
            board.start_connection()
        self.bridge_number += 1
        ports = {link: line.port for link, line in self.lines.items()}
        self.bridge_name = f'bridge_{self.bridge_number}'
        self.child_bridge = self.bridge(
            ports, PARAMETERS, self.bridge_name,
            [*self._bridge, f'__log:={self.path(self.bridge_name)}.log'])
        self.wait_for_bridge()

    def end_bridge(self) -> None:
        self.end(self.child_bridge)
        self.check_always()

    def check_always(self) -> None:
        """Check what holds at any time: the log and the heartbeats."""
        log = Path(self.path(f'{self.bridge_name}.log')).read_text(errors='replace')
        self.row('no traceback and no stuck link in the log').check(
            not re.search('Traceback|fault in the bridge|the bridge is stuck', log), log[-300:])
        required = self.row('no gap of 30 ms between heartbeats, whatever else happens')
        required.keep_worst(self.car.longest_gap * 1e3, 'ms')
        required.checks += self.car.all_beats - self._checked_beats
        gaps, self.car.gaps, self._checked_beats = self.car.gaps, [], self.car.all_beats
        for since, until in gaps if self.machine.real_time else ():     # else it is not promised
            self.in_time(required, since, until, BEAT_MISSED, f'at {since:.3f}')

    def in_time(self, required: Requirement, since: float, until: float, limit: float,
                text: str) -> None:
        """Check the time between two events, in s. It is not decided if a witness was late, too,
        and by as much as the limit was exceeded by, not counting `MARGIN`."""
        seconds = until - since
        excess = seconds - limit
        if excess > 0 and self.machine.late(since, until) >= max(LATE, excess - MARGIN):
            required.undecided += 1
        elif required.check(excess <= 0, f'{text}: {seconds * 1e3:.1f} ms, limit '
                            f'{limit * 1e3:g} ms'):
            required.keep_worst(seconds * 1e3, 'ms')

    def wait_for_bridge(self) -> None:
        """Until it serves every link that is plugged in, and is connected to the robot."""
        child = self.child_bridge
        self.wait(lambda: not child.alive or self.robot.connected
                  and (not self.car_line.plugged or self.car.beats > 20), 'the bridge is up')
        self.check(child)
        self.wait(lambda: self.robot.request(codec.ECHO, 0, b'').success,
                  'the bus board is in step')
        seen: Set[str] = set()
        self.robot.on_value = lambda topic, key: seen.add(topic)
        self.wait(lambda: self._measure_all() or seen.issuperset(TOPICS), 'values are published')
        self.robot.on_value = lambda topic, key: None
        time.sleep(_QUIET)

    def _measure_all(self) -> None:
        self.measure()
        self.sensors.cliff()

    def subscriber(self, *topics: str) -> Child:
        """Start a process that subscribes to these topics; wait until it has."""
        child = self.child(f'subscriber_{self.bridge_number}', [
            sys.executable, '-m', __package__ + '.subscriber', *topics])
        self.wait(lambda: 'ready' in child.tail() or not child.alive, 'a subscriber')
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

    def _wait_for_beat(self, seconds: float) -> None:
        """Wait so long, and then for a heartbeat, so that the next one is not about to be written:
        if the bridge is suspended just then, it is sent before SPEED 0."""
        until = time.monotonic() + seconds
        while time.monotonic() < until or (self.car.beat_at < until and self.car_line.plugged
                                           and time.monotonic() < until + BEAT_MISSED):
            time.sleep(0.001)

    def measure(self) -> None:
        """Let the car and the sensor board send their measurements."""
        self.car.measure()
        self.sensors.measure()
