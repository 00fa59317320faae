"""All names of the bridge that the judge uses: a rebuild of the bridge changes this file alone."""
# flake8: noqa: F401  much of it is what mutants break
import logging
import os
from types import SimpleNamespace
from typing import Any, Callable, Dict, List, Optional, Tuple

from device import Device
from world import Loop, World

from serial_communication.boards.arduino import custom_messages, settings
from serial_communication.boards.arduino.heartbeat import HeartbeatThread
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.boards.arduino.motor import Motor, Stop
from serial_communication.boards.arduino.output import CarOutput
from serial_communication.boards.arduino.simulator import ModelCar
from serial_communication.boards.bus import wire as bus_wire
from serial_communication.boards.bus.call import Queue
from serial_communication.boards.bus.functions import read_functions
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.bus.master import Master
from serial_communication.boards.bus.session import Session, State
from serial_communication.boards.bus.simulator import ControlBoard as BusBoard
from serial_communication.boards.mcu.link import McuLink
from serial_communication.boards.mcu.simulator import SensorBoard
from serial_communication.framing.announcement import read_announcement, write_announcement
from serial_communication.framing.custom_messages import CustomMessage
from serial_communication.link.announcement import BoardAnnouncement
from serial_communication.link.connection import Connection
from serial_communication.link.link import Link
from serial_communication.link.outcome import Refused
from serial_communication.link.settings import BoardSettings
from serial_communication.link.stamps import Stamps
from serial_communication.simulation.faults import Faults, parse
from serial_communication.simulation.line import SimulatedLine
from serial_communication.transport.port import Port


class ControlBoard(BusBoard):
    """Replies with the values of the request, so that a reply tells whose it is."""

    def _custom_function(self, function: Any, request: Any, now: float) -> Any:
        reply = super()._custom_function(function, request, now)
        return reply._replace(data=request.data) if reply.data else reply


def line_of(board: Any, write: Callable[[bytes], None], journal: Any,
            drift: Optional[float]) -> SimulatedLine:
    """The board's end of a line; `drift`, ppm: the board sends its time."""
    return SimulatedLine(board, write, Faults(parse(
        [] if drift is None else [f'drift={drift}'], board)), journal)


class SimPort(Port):
    """The bridge's port on a device."""

    def __init__(self, world: World, device: Device) -> None:
        scheme = 'socket://sim:1' if device.kind == 'network' else '/dev/sim'
        super().__init__(scheme, 115200, now=world.clock)
        self._world, self._device = world, device
        for descriptor in self._wake_read, self._wake_write:     # nothing sleeps
            os.close(descriptor)

    def _open(self) -> Any:
        self._refuse_while_lent('')
        device = self._device
        device.open()
        return SimpleNamespace(
            is_pty=device.kind == 'pty', has_baud=device.kind == 'tty', escaped=bytes,
            read=lambda _timeout, _wants_room: device.read(65536), send=device.send,
            unsent=device.unsent, on_its_way=device.unsent, discard_output=device.flush_output,
            restore_settings=device.restore, pulse=lambda _line: device.pulse(),
            close=lambda _is_held: device.close())

    _others_have = staticmethod(lambda _path: False)

    def pause(self, seconds: float) -> None:
        pass

    def drain(self, seconds: float) -> None:
        self._world.wait(self._device.drain(seconds))


class Robot:
    """A link of the bridge with its loops, and what it published: (time, name, values, stamp)."""

    def __init__(self, world: World, device: Device, kind: str, rows: Dict[str, Any],
                 is_tapped: bool, **parameters: Any) -> None:
        self.world, self.device, self.kind = world, device, kind
        self.published: List[Tuple[float, str, Any, float]] = []
        self.calibrating: List[Tuple[float, bool]] = []
        self.tapped: List[Tuple[int, bytes, str]] = []      # direction, frame, why it is invalid
        port = SimPort(world, device)
        options = {'clock': world.clock, 'now': world.clock, 'logger': logging.Logger('judge', 100)}
        self.link: Any
        if kind == 'arduino':
            self.link = ArduinoLink(
                port, ArduinoSettings(**parameters), on_message=self._publish,
                on_calibrating=lambda on: self.calibrating.append((world.clock(), on)),
                messages=[row.kind for row in self.rows(rows) if not row.is_command], **options)
            self.link.output.motor.awake(world.clock())
        elif kind == 'mcu':
            self.link = McuLink(
                port, on_status=lambda message, seq, stamp: self._publish(message, stamp),
                on_silence=lambda kind, seq, age: self.published.append(
                    (world.clock(), 'silent', (kind.__name__ if kind else '', age), 0.0)),
                **parameters, **options)
        else:
            self.link = BusLink(port, BusSettings(**parameters), nonce=lambda: bytes(
                world.random.randrange(256) for _ in range(4)), on_environment=self._publish,
                **options)
        self.loops = [Loop(world, step) for step in self.link.loops()]
        port.wake = device.on_input = self.loops[0].wake    # type: ignore[method-assign]
        if is_tapped:
            self.link.tap = lambda _name, direction, frame: self.tapped.append(
                (direction, frame.raw, frame.cause))
        self.link.lending.line = 'dtr'
        self.link.announcement.on_text = lambda text: world.after(
            world.random.uniform(0.0, 0.3), lambda: self._use(text))
        self._made: List[Callable[[], None]] = []
        self.functions: Dict[str, Any] = {}     # of the bus
        self.grippers = [row.kind for row in self.rows(rows) if row.is_command]    # or none now

    def use_functions(self, rows: Dict[str, Any], announced: bool) -> None:
        """Use these functions of the bus."""
        self.functions = {each.name: each._replace(announced=announced)
                          for each in read_functions(rows)}
        self.link.stops = [(each.make_request(()), each) for each in self.functions.values()
                           if each.interrupts]

    @staticmethod
    def rows(rows: Dict[str, Any]) -> List[CustomMessage]:
        return custom_messages({name: row for name, row in rows.items() if 'setting' not in row})

    def _publish(self, message: Any, stamp: float) -> None:
        self.published.append((self.world.clock(), type(message).__name__, tuple(message), stamp))

    def _use(self, text: bytes) -> None:
        """Use the rows of an announcement, as the ROS side does."""
        for take_down in self._made:
            take_down()
        self._made, self.grippers = [], []
        announced = read_announcement(text)
        if self.kind == 'bus':
            self.use_functions(announced.rows, True)
        for row in self.rows(announced.rows) if self.kind != 'bus' else ():
            row.kind.ANNOUNCED = True
            if row.is_command:
                self.grippers.append(row.kind)
            else:
                self.link.decoder.add_message(row.kind)
                self._made.append(lambda kind=row.kind: self.link.decoder.remove_message(kind))
        for setting in settings({
                name: row for name, row in announced.rows.items() if 'setting' in row}):
            self._made.append(self.link.board_settings.add(setting, announced=True))
        self.link.announcement.use(text, announced.firmware, list(announced.rows))

    # -- what people and programs do -----------------------------------------------------------

    def command(self, name: str, *values: Any) -> str:
        """Send a command to the car: '' if it was accepted, else why it was refused."""
        try:
            {'speed': self.link.set_speed, 'steering': self.link.set_steering,
             'led': self.link.set_led, 'calibrate': self.link.calibrate_imu,
             'row': self.link.command}[name](*values)
        except Refused as refused:
            return refused.cause
        return ''

    def call(self, cmd1: int, cmd2: int, data: bytes, function: Optional[Any] = None) -> Any:
        """Call the bus; return the call, which has an `outcome` once it is over."""
        return self.link.submit(bus_wire.Request(cmd1, cmd2, data), function or bus_wire.built_in(
            bus_wire.Request(cmd1, cmd2, data), bus_wire.RAW))

    def stop(self, holds: bool) -> str:
        self.link.is_stopped = holds
        return self.link.stop_motion() if holds else ''

    def lend_or_reset(self, seconds: float) -> Any:
        lending = self.link.lending
        return lending.ask_for_loan('judge', seconds) if seconds else lending.ask_for_reset()

    def report(self) -> Dict[str, Any]:
        return dict(self.link.report(self.world.clock()).values)

    def end(self) -> None:
        """The node ends."""
        self.link.stop()
        for loop in self.loops[1:]:
            loop.end()
