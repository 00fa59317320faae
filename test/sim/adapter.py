"""All names of the bridge that the judge uses: a rebuild of the bridge changes this file alone, and
where mutants.py breaks it. The boards at the other end are in simulated.py."""
import os
from functools import partial
from types import SimpleNamespace
from typing import Any, Callable, Dict, List, Tuple

from device import Device
from world import Loop, World

from serial_communication.boards.arduino import DESCRIPTION as CAR
from serial_communication.boards.arduino import wire as car_wire
from serial_communication.boards.arduino.session import CarOptions, CarSession
from serial_communication.boards.bus import DESCRIPTION as BUS
from serial_communication.boards.bus import wire as bus_wire
from serial_communication.boards.bus.call import MasterOptions
from serial_communication.boards.bus.link import BusLink
from serial_communication.boards.bus.session import MasterSession
from serial_communication.boards.mcu.session import SensorSession
from serial_communication.framing.announcement import read_announcement
from serial_communication.framing.rows import BOARD, FILE, Kind
from serial_communication.link.link import Link
from serial_communication.link.outcome import Refused
from serial_communication.link.sparing_log import SparingLog
from serial_communication.transport.port import Port


def read_rows(rows: Dict[str, Any], origin: str = FILE) -> List[Any]:
    """The messages, commands and settings of a board that sends on its own."""
    return [row for name, given in rows.items()
            for row in CAR.group_of(given).read({name: given}, 'rows', origin)]


def parts_of(rows: Dict[str, Any]) -> Tuple[List[Any], List[Any]]:
    """The custom messages among these rows, and the settings."""
    read = read_rows(rows)
    return ([row for row in read if row.kind is not Kind.SETTING],
            [row for row in read if row.kind is Kind.SETTING])


def read_functions(rows: Dict[str, Any], origin: str = FILE) -> List[Any]:
    """Functions of the bus."""
    return BUS.groups[0].read(rows, 'rows', origin)


class SimPort(Port):
    """The bridge's port on a device."""

    def __init__(self, world: World, device: Device) -> None:
        super().__init__('socket://sim:1' if device.kind == 'network' else '/dev/sim', 115200)
        self._world, self._device = world, device
        for descriptor in self._wake_read, self._wake_write:     # nothing sleeps
            os.close(descriptor)

    def _open(self) -> Any:
        device = self._device
        device.open()
        return SimpleNamespace(
            is_pty=device.kind == 'pty', has_baud=device.kind == 'tty', escaped=bytes,
            read=lambda _timeout, _wants_room: device.read(65536), send=device.send,
            unsent=device.unsent, on_its_way=device.unsent, renew=device.renew,
            changed_settings=lambda: device.is_altered,
            pulse=lambda _line: device.pulse(), close=device.close)

    is_used = staticmethod(lambda: False)       # type: ignore[assignment]
    pause = staticmethod(lambda _seconds: None)     # type: ignore[assignment]

    def drain(self, seconds: float) -> None:
        self._device.drain(seconds)


_BUILT_IN = {row.name: row for row in CAR.rows if row.kind is Kind.TO}
_WORDS = {3: 'failed', 253: 'not sent', 254: 'not known', 255: 'refused'}


class Robot:
    """A link of the bridge with its loops, and what it published: (time, name, values, stamp)."""

    def __init__(self, world: World, device: Device, kind: str, rows: Dict[str, Any],
                 is_tapped: bool, **parameters: Any) -> None:
        self.world, self.device, self.kind = world, device, kind
        self.published: List[Tuple[float, str, Any, float]] = []
        self.calibrating: List[Tuple[float, bool]] = []
        self.tapped: List[Tuple[int, bytes, str]] = []      # direction, frame, why it is invalid
        port = SimPort(world, device)
        self.said: List[Tuple[float, int, str]] = []        # lines of the log, and their levels
        log = SparingLog(kind, self, clock=world.clock)     # type: ignore[arg-type]
        clocks: Any = {'clock': world.clock, 'now': world.clock}
        self.link: Any
        if kind == 'arduino':
            self.link = Link(port, CarSession(
                log, CarOptions(**parameters), on_message=self._publish,
                on_calibrating=lambda on: self.calibrating.append((world.clock(), on))), **clocks)
        elif kind == 'mcu':
            self.link = Link(port, SensorSession(
                log, on_status=lambda message, seq, stamp: self._publish(message, stamp),
                on_silence=lambda kind, seq, age: self.published.append(
                    (world.clock(), 'silent', (kind.__name__ if kind else '', age), 0.0)),
                now=world.clock, **parameters), **clocks)
        else:
            period = parameters.pop('environment_period', 1.0)
            session = MasterSession(
                log, MasterOptions(**parameters),
                nonce=lambda: bytes(world.random.choices(range(256), k=4)))
            if period:
                session.polls.add(bus_wire.ENVIRONMENT_FUNCTION, period, lambda outcome:
                                  self._publish(bus_wire.Environment.unpack(outcome.data),
                                                outcome.stamp))
            self.link = BusLink(port, session, **clocks)
        self.loops = [Loop(world, step) for step in self.link.loops().values()]
        port.wake = device.on_input = self.loops[0].wake    # type: ignore[method-assign]
        if is_tapped:
            self.link.session.tap = lambda _name, direction, frame: self.tapped.append(
                (direction, frame.raw, frame.cause))
        self.link.lending.reset_line = 'dtr'
        self.link.session.announcement.on_text = lambda text: world.after(
            world.random.uniform(0.0, 0.3), lambda: self._use(text))
        self._made: List[Callable[[], None]] = []       # what takes down the rows in use
        self.used: List[Tuple[float, List[str]]] = []   # when announced rows came into use
        self.functions: Dict[str, Any] = {}     # of the bus, by name
        self.commands: Dict[str, Any] = {}      # the rows to the car
        self._use_rows(rows, FILE)

    def _use_rows(self, rows: Dict[str, Any], origin: str) -> None:
        """Use these rows, as the ROS side does."""
        link, made = self.link, self._made
        if self.kind == 'bus':
            self.functions = {each.name: each for each in read_functions(rows, origin)}
            link.session.stops = [(each.make_request(()), each)
                                  for each in self.functions.values() if each.interrupts]
            return
        for row in read_rows(rows, origin):
            if row.kind is Kind.SETTING:
                made.append(link.session.board_settings.add(row))
            elif row.kind is Kind.TO:
                self.commands[row.name] = row
            else:
                link.session.decoder.add_message(row.message)
                made.append(partial(link.session.decoder.remove_message, row.message))
            if row.motion:
                link.session.add_motion(row.zero)
                made.append(partial(link.writer.write, partial(
                    link.session.remove_motion, row.zero)))

    def _use(self, text: bytes) -> None:
        """Use the rows of an announcement instead."""
        while self._made:
            self._made.pop()()
        self.commands.clear()
        announced = read_announcement(text)
        self._use_rows(announced.rows, BOARD)
        self.link.session.announcement.use(text, announced.firmware, list(announced.rows))
        self.used.append((self.world.clock(), list(announced.rows)))

    def log(self, level: int, form: str, *words: Any) -> None:
        """A line of the link's log."""
        self.said.append((self.world.clock(), level, form % words))

    def _publish(self, message: Any, stamp: float) -> None:
        self.published.append((self.world.clock(), type(message).__name__, tuple(message), stamp))

    # -- what people and programs do -----------------------------------------------------------

    def command(self, name: str, *values: Any) -> str:
        """Send a command to the car: '' if it was accepted, else why it was refused."""
        link = self.link

        def send_row(*values: Any) -> None:
            row = self.commands.get(name) or _BUILT_IN[name]
            link.writer.submit(row.message(*(row.saturated(values)[0] if row.motion else values)))

        if name == 'calibrate':
            values = (car_wire.ImuCalibration(),)
            send = link.writer.submit
        else:
            send = send_row
        try:
            send(*values)
        except Refused as refused:
            return refused.cause
        return ''

    def call(self, cmd1: int, cmd2: int, data: bytes, name: str,
             told: Callable[[str, bytes, str], None]) -> Tuple[bool, float]:
        """Call the bus; `told` gets what its caller is told: a word, the data and a text. Return
        whether it may be repeated, and how long it takes once it is its turn, at most."""
        request = bus_wire.Request(cmd1, cmd2, data)
        function = self.functions.get(name) or bus_wire.BUILT_IN.get(request[:2], bus_wire.RAW)
        call = self.link.submit(request, function)
        finish = call.finish

        def finished(outcome: Any) -> None:
            finish(outcome)
            last = call.outcome
            told('done' if last.success else _WORDS.get(last.status, 'answered'), last.data,
                 last.message)

        call.finish = finished
        if call.outcome is not None:
            finished(call.outcome)
        return function.repeatable, call.tries * call.timeout

    def want(self, name: str, value: float) -> bool:
        """Set a setting; return whether it is there."""
        self.link.session.board_settings.want(name, value)
        return name in self.link.session.board_settings.shown()

    def stop(self, holds: bool) -> str:
        self.link.session.is_stopped = holds
        return self.link.stop_motion() if holds else ''

    def lend_or_reset(self, seconds: float) -> Any:
        """The `answer` of a loan or a reset: whether it was granted, and what is said."""
        lending = self.link.lending
        try:
            return SimpleNamespace(answer=(
                True, lending.lend('judge', seconds) if seconds else lending.reset()))
        except Refused as refused:
            return SimpleNamespace(answer=(False, str(refused)))

    def report(self) -> Dict[str, Any]:
        return dict(self.link.report(self.world.clock()).values)

    def end(self) -> None:
        """The node ends."""
        self.link.stop()
        for loop in self.loops[1:]:
            loop.end()
