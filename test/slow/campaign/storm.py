"""All faults at once, and damage on every line, for any duration.

Every check uses only the last seconds, so the memory that a run needs does not grow.
"""
import collections
import contextlib
import functools
import itertools
import random
import signal
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, Deque, Dict, Optional, Tuple

import by_definition as codec
from .boards import DEPTH, HEIGHT, Board, Reaction, Request, reply_frame
from .damage import DamagedLine
from .lines import NetworkLine
from .rig import MOTION_TIMEOUT, Rig
from .storm_checks import CallCheck, GrowthCheck, MotorCheck, ValueCheck

_DAMAGE_SHARE = 0.03     # of the frames
_STALLS = 0.2, 0.4, 0.7, 1.2     # s for which the bridge is suspended
# s for which a network is frozen; that of the bus not until three ECHOs are lost.
_FREEZES = {'bus': (0.2, 0.5), 'arduino': (0.3, 1.0, 2.0, 5.0), 'mcu': (0.3, 1.0, 3.0, 6.0)}
_MEASURE_PERIOD = 0.02   # s
_USAGE_PERIOD = 0.5      # s
_RECORDS = 20000         # records that are kept to be written at the first violation
_REFUSED = reply_frame(codec.INVALID, bytes((codec.BAD_CHECKSUM,)))
_FAILED = reply_frame(codec.ERROR, struct.pack('<H', codec.FAILED))


class Storm:
    """One run with so many `busy` processes that use all CPU time."""

    def __init__(self, rig: Rig, duration: float, seed: str, busy: int) -> None:
        self.rig, self._duration, self._busy = rig, duration, busy
        self._random = random.Random(f'storm {seed}')
        self._stopping = threading.Event()
        # A bridge that is suspended cannot close the connection to a network that is frozen.
        self._either = threading.Lock()
        self._records: Deque[Tuple] = collections.deque(maxlen=_RECORDS)
        self._boards: Dict[str, Any] = {'arduino': rig.car, 'bus': rig.bus, 'mcu': rig.sensors}
        self._to_bridge = {link: DamagedLine(board.sent_frame_at, self._random, _DAMAGE_SHARE)
                           for link, board in self._boards.items()}
        self._to_bus = DamagedLine(codec.request_at, self._random, _DAMAGE_SHARE)
        self._motor, self._calls = MotorCheck(rig), CallCheck(rig)
        self._values = ValueCheck(rig)

    def __str__(self) -> str:
        return (f"all faults at once, for {self._duration:g} s"
                f"{' over networks' * self.rig.is_network}")

    def run(self) -> None:
        rig = self.rig
        rig.start()
        self._connect()
        traffic = rig.robot.subscribe_to_traffic()
        subscriber = rig.subscriber(*rig.robot.topics)
        children = [subscriber, *rig.busy(self._busy)]
        loops = (self._measure, self._drive, self._make_calls, self._make_calls,
                 lambda: self._disturb('mcu', 4.0), lambda: self._disturb('bus', 6.0),
                 lambda: self._disturb('arduino', 5.0), lambda: self._suspend(subscriber))
        with ThreadPoolExecutor(len(loops)) as pool:
            running = [pool.submit(loop) for loop in loops]
            try:
                self._disturb_for_its_time()
            finally:
                self._stopping.set()
                wait(running, 5.0)
                traffic.unregister()
                for child in children:
                    rig.end(child)
                rig.end_bridge()        # also ends calls that hang
                rig.robot.on_value = lambda topic, key: None
                rig.table.on_violation.remove(self._on_violation)
        self._motor.judge()
        for each in running:
            each.result()       # raises what the loop has raised
        rig.row('frames that were damaged, in both directions').checks += sum(
            each.damaged for each in (*self._to_bridge.values(), self._to_bus))

    def _disturb_for_its_time(self) -> None:
        growth, until = GrowthCheck(self.rig, self._duration), time.monotonic() + self._duration
        with self.rig.clock.each(_USAGE_PERIOD, growth.measure):
            self._disturb_bridge(until)
        growth.judge()

    def _disturb_bridge(self, until: float) -> None:
        while time.monotonic() < until:
            self.wait(self._random.uniform(2.0, 6.0))
            with self._either, self._values.disturbance(), self.rig.suspended():
                self._record('bridge', 'suspended')
                self.wait(self._random.choice(_STALLS))
                self._motor.resumed()
            self._motor.judge()
            self._values.judge()
            self._calls.judge()
            self.rig.check_always()
            self.rig.check(self.rig.child_bridge)

    def wait(self, seconds: float) -> bool:
        """Wait; return whether the storm continues."""
        return not self._stopping.wait(seconds)

    def _record(self, *what: Any) -> None:
        self._records.append((round(time.monotonic(), 4), *what))

    def _on_violation(self, requirement: str, text: str) -> None:
        """Write the latest records to a file, at the first violation."""
        self._record('VIOLATED', requirement, text)
        path = self.rig.path(f'violation_{self.rig.bridge_name}.txt')
        with contextlib.suppress(FileExistsError), open(path, 'x') as file:
            file.writelines(f'{record}\n' for record in list(self._records))

    # -- lines and boards ---------------------------------------------------------------------

    def _connect(self) -> None:
        """Let the lines damage what they transfer, and the boards keep no records."""
        rig = self.rig
        rig.table.on_violation.append(self._on_violation)
        rig.robot.on_value = self._values.published
        rig.car.on_packet, rig.car.on_beat = self._motor.received, self._motor.heartbeat
        rig.bus.on_request, rig.bus.executed = self._calls.received, self._calls.executed
        rig.bus.react, rig.bus.check_fence = self._react, self._calls.fences.append
        for link, board in self._boards.items():
            board.line.damage = functools.partial(self._damage, link, board)
            board.line.on_unplugged = functools.partial(self._unplugged, link, board)
        rig.bus.line.on_bytes = self._to_bus_board

    def _unplugged(self, link: str, board: Board) -> None:
        self._to_bridge[link].reset()
        if link == 'bus':
            self._to_bus.reset()
        elif link == 'arduino':
            self._motor.start_connection()
        board.start_connection()

    def _damage(self, link: str, board: Board, data: bytes) -> bytes:
        """Return what the bridge receives of a frame."""
        line, frame = self._to_bridge[link], codec.decode(data, board.sent_frame_at)[0][0]
        must_arrive = not line.is_open
        received = line.pass_on(data, link != 'bus' or frame.type != codec.ECHO)
        if received == data:
            self._values.sent(board.keys(frame), must_arrive)
        self._record(link, 'to the bridge', data.hex(), received.hex())
        return received

    def _to_bus_board(self, data: bytes, now: float) -> None:
        """An ECHO is never damaged: after three lost ones no call is sent."""
        for frame in codec.decode(data, codec.request_at)[0]:
            sent = data[frame.start:frame.end]
            received = self._to_bus.pass_on(sent, frame.type != codec.ECHO)
            self._record('bus', 'to the board', sent.hex(), received.hex())
            self.rig.bus.read(received, now)
            if received != sent and self._random.random() < 0.5:
                self.rig.bus.line.write(_REFUSED)

    def _react(self, request: Request) -> Optional[Reaction]:
        """How the board reacts to a function."""
        if request.cmd2 in (DEPTH, HEIGHT, codec.ENVIRONMENT):
            return None
        ok, number = self.rig.bus.ok_reply(request), self._random.randrange(20)
        if number == 0:
            self._calls.invalid(request.key)
        return {0: Reaction([(0, _REFUSED)]), 1: Reaction([(0, _FAILED)]),
                2: Reaction(), 3: Reaction([], True),
                4: Reaction([(MOTION_TIMEOUT + 0.1, ok)], True),
                5: Reaction([(0, ok), (0.005, ok)], True),
                6: Reaction([(0, ok), (0.01, ok)], True),
                7: Reaction([(0.01, ok)], True)}.get(number, Reaction([(0, ok)], True))

    # -- what goes on at the same time --------------------------------------------------------

    def _measure(self) -> None:
        while self.wait(_MEASURE_PERIOD):
            self.rig.measure()
            self.rig.sensors.cliff()

    def _drive(self) -> None:
        for value in itertools.cycle([*range(-999, 0), *range(1, 1000)]):
            chance = self._random.random()
            self._motor.command(0 if chance < 0.05 else value)
            # Now and then so long that the bridge stops the car.
            if not self.wait(1.0 if chance > 0.95 else self._random.uniform(0.02, 0.1)):
                return

    def _make_calls(self) -> None:
        while self.wait(0.01):
            self._calls.call()

    def _suspend(self, subscriber: Any) -> None:
        while self.wait(self._random.uniform(0.5, 2.0)):
            subscriber.hold()
            self.wait(self._random.uniform(2.0, 6.0))
            subscriber.send(signal.SIGCONT)

    def _disturb(self, link: str, seconds: float) -> None:
        """Every so many seconds unplug a line; close or freeze a connection."""
        line, rand = self.rig.lines[link], self._random
        while self.wait(rand.uniform(0.5, 2 * seconds)):
            if not line.plugged:        # the bridge has not connected yet
                continue
            with self._values.disturbance(link):
                self._record(link, 'disturbed')
                if isinstance(line, NetworkLine) and rand.random() < 0.5:
                    self._freeze(line, rand.choice(_FREEZES[link]))
                else:
                    line.unplug()
                    self.wait(rand.uniform(0.05, 1.0))
                    line.plug(another_name=rand.random() < 0.3)
                self._record(link, 'continues')

    def _freeze(self, line: NetworkLine, seconds: float) -> None:
        with self._either:
            line.freeze()
            self.wait(seconds)
            if line is self.rig.car_line:       # what waited is read only now
                self._motor.resumed()
                self.rig.car.forget_beat()
            line.thaw()
