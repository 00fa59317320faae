"""The simulated control board: lift, gimbal and environment, the Slave on a robot-ctrl-bus.

It answers every valid request once, in order, and sends nothing else. Requests that it receives
during a motion are answered afterwards, as by a board with one loop. But a custom function that
interrupts ends the motion at once, which is then answered with ERROR 0x8002, and requests that wait
are dropped.

Its answer to an invalid request is a matter of safety. INVALID means that nothing was executed, so
the Master sends the request again. But noise can look like an invalid frame, with a valid request
right after it: a board that answers INVALID and then executes that request moves its lift twice. So
it sends INVALID only for a frame with a wrong checksum, and only after `FRAME_TIMEOUT` of silence
without a valid request. Noise, incomplete frames and bytes after a valid request get no answer; the
Master's timeout deals with them.

    function     range                       speed                     refused with
    lift         0 … 1000 mm, starts at 500  100 mm/s                  0x8002 out of range
    gimbal pan   -170 … 170°, left is +      90 °/s                    0x8002 out of range
    gimbal tilt  -90 … 90°, up is +          90 °/s                    0x8002 out of range
    environment  drifts about 130 raw, 22 °C, 45 %
    0x55 0xF0    stores its DATE and answers OK with the same DATE: a function that no bridge
                 knows, for trying raw requests
"""
import argparse
import math
from collections import deque
from random import Random
from typing import Deque, Iterable, NamedTuple, Optional, Tuple

from ...framing.stream import CHECKSUM, Frame
from ...simulation.announcing import chunks_of
from ...simulation.board import FRAME_TIMEOUT, Board, positive
from ...simulation.custom_messages import CHUNK, simulated_values
from . import DESCRIPTION, wire

MEMORY = 0xF0            # CMD2 of the function that no bridge knows
LIFT_RANGE = (0, 1000)   # mm
LIFT_START = 500
PAN_RANGE = (-170, 170)  # degrees, as those of the reference firmware
TILT_RANGE = (-90, 90)
LIFT_SPEED = 100.0       # mm/s
GIMBAL_SPEED = 90.0      # degrees/s

_MOST_QUEUED = 16        # requests that can wait during a motion; more are lost


class Axis:
    """An axis that moves at constant speed between two limits."""

    def __init__(self, position: float, limits: Tuple[float, float], speed: float) -> None:
        self.limits = limits
        self.speed = speed
        self._from = self._to = float(position)
        self._since = 0.0

    def at(self, now: float) -> float:
        """Its position."""
        distance = self._to - self._from
        moved = min(max(now - self._since, 0.0) * self.speed, abs(distance))
        return self._from + math.copysign(moved, distance)

    def allows(self, distance: float, now: float) -> bool:
        """Whether it stays within its limits if it moves by `distance`."""
        return self.limits[0] <= round(self.at(now) + distance, 6) <= self.limits[1]

    def move(self, distance: float, now: float) -> float:
        """Start to move by `distance`; return when the motion ends."""
        self._from = self.at(now)
        self._to = self._from + distance
        self._since = now
        return now + abs(distance) / self.speed

    def halt(self, now: float) -> None:
        """Stop where it is."""
        self._from = self._to = self.at(now)


class _Motion(NamedTuple):
    """The motion that is being executed."""

    until: float
    request: wire.Request


class ControlBoard(Board):
    """See the module.

    Args:
        lift_speed, gimbal_speed: mm/s and degrees/s.
        reply_has_cmd2: whether replies carry their request's CMD2.
        echoes: whether it answers ECHO.
        ok_data: DATE of its OK to a move.
        seed: seed of the environment's noise.
        custom: custom functions; the values of their replies vary with time.
        announcement: the text to announce; None: nothing.
    """

    decoder: wire.RequestDecoder
    NAME = DESCRIPTION.name
    SUMMARY = 'main control board: lift, gimbal, environment'
    FAULTS = ('drop=0.01 cut=0.01 lose=0.01 flip=0.01 insert=0.01 double=0.01 delay=0.01:0.1-1 '
              'rx-drop=0.005 rx-lose=0.005 rx-flip=0.01 rx-insert=0.005 '
              'silence=0.5/min stall=0.5/min reset=0.5/min')
    CHATTER = b'\r\nboot 1.4\r\nRAM ok\r\nlift: ok gimbal: ok\r\n'

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument('--lift-speed', type=positive, default=LIFT_SPEED, metavar='MM/S',
                            help='speed of the lift (%(default)g)')
        parser.add_argument('--gimbal-speed', type=positive, default=GIMBAL_SPEED,
                            metavar='DEG/S', help='speed of the gimbal (%(default)g)')
        parser.add_argument('--reply-has-cmd2', action='store_true',
                            help="replies carry their request's CMD2")
        parser.add_argument('--no-echo', action='store_true', help='never answer ECHO')
        parser.add_argument('--ok-data', type=bytes.fromhex, default=b'', metavar='HEX',
                            help='data in the OK to a move, such as 0102')

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> 'ControlBoard':
        return cls(options.lift_speed, options.gimbal_speed, options.reply_has_cmd2, options.seed,
                   not options.no_echo, options.ok_data, options.config, options.announcement)

    def __init__(self, lift_speed: float = LIFT_SPEED, gimbal_speed: float = GIMBAL_SPEED,
                 reply_has_cmd2: bool = False, seed: int = 0, echoes: bool = True,
                 ok_data: bytes = b'', custom: Iterable[wire.Function] = (),
                 announcement: Optional[bytes] = None) -> None:
        super().__init__(wire.RequestDecoder())
        self._custom = {function.number: function for function in custom}
        self._chunks = [] if announcement is None else chunks_of(announcement, CHUNK)
        self.lift = Axis(LIFT_START, LIFT_RANGE, lift_speed)
        self.pan = Axis(0, PAN_RANGE, gimbal_speed)
        self.tilt = Axis(0, TILT_RANGE, gimbal_speed)
        self.memory = b''
        self.synchronised = False
        self._reply_has_cmd2 = reply_has_cmd2
        self._echoes = echoes
        self._ok_data = ok_data
        self._random = Random(f'{seed} air')
        self._motion: Optional[_Motion] = None
        self._queue: Deque[wire.Request] = deque()
        self._owes_invalid = False      # INVALID has to answer a request
        self._valid = False     # a valid request was received with, or just before, these bytes

    # -- hooks ----------------------------------------------------------------------------

    def power_on(self, now: float) -> None:
        self.decoder.reset()
        self.synchronised = False
        self.memory = b''
        self._motion = None
        self._queue.clear()
        self._owes_invalid = self._valid = False

    def power_off(self, now: float) -> None:
        for axis in (self.lift, self.pan, self.tilt):
            axis.halt(now)

    def receive(self, data: bytes, now: float) -> None:
        if not self.decoder.begun:
            self._valid = False    # these bytes do not belong to an earlier request
        super().receive(data, now)

    def frame(self, frame: Frame, now: float) -> None:
        request = frame.message
        if request is None:
            if frame.cause == CHECKSUM and not self._valid and not self._motion:
                self._owes_invalid = True
            return
        self._valid = True
        self._owes_invalid = False
        if self._motion and self._interrupts(request):
            self._stop(self._motion, now)
        if self._motion is None:
            self._serve(request, now)
        elif len(self._queue) < _MOST_QUEUED:
            self._queue.append(request)

    def advance(self, now: float) -> Optional[float]:
        motion = self._motion
        if motion and now >= motion.until:
            self._motion = None
            self._reply(wire.Reply(wire.OK, self._ok_data), motion.request)
        while self._queue and self._motion is None:
            self._serve(self._queue.popleft(), now)
        if self._motion:
            return self._motion.until
        if self._owes_invalid:
            silent_until = self._last_byte + FRAME_TIMEOUT
            if now < silent_until:
                return silent_until
            self.line.say('received a request with a wrong checksum; answering INVALID')
            self._reply(_invalid(wire.CHECKSUM_MISMATCH))
        return None

    # -- requests -------------------------------------------------------------------------

    def _interrupts(self, request: wire.Request) -> bool:
        return (self.synchronised and request.cmd1 == wire.FUNCTION and request.cmd2 in self._custom
                and self._custom[request.cmd2].interrupts)

    def _stop(self, motion: '_Motion', now: float) -> None:
        """End the motion, and drop the requests that wait."""
        self._motion = None
        for axis in (self.lift, self.pan, self.tilt):
            axis.halt(now)
        self._queue.clear()
        self.line.say(f'stopped at {round(self.lift.at(now), 1):g} mm, '
                      f'{round(self.pan.at(now), 1):g}°, {round(self.tilt.at(now), 1):g}°')
        self._reply(_error(wire.OPERATION_FAILED), motion.request)

    def _serve(self, request: wire.Request, now: float) -> None:
        reply: Optional[wire.Reply]
        if request.cmd1 == wire.SYNC:
            if not self.synchronised:
                self.line.say('synchronised')
            self.synchronised = True
            reply = wire.Reply(wire.SYNC)
        elif not self.synchronised:
            reply = _invalid(wire.NOT_SYNCHRONISED)
        elif request.cmd1 == wire.ECHO:
            reply = wire.Reply(wire.ECHO, request.data) if self._echoes else None
        elif request.cmd1 == wire.FUNCTION:
            reply = self._function(request, now)
        else:
            reply = _error(wire.UNSUPPORTED)
        if reply is not None and reply.cmd1 in (wire.ERROR, wire.INVALID):
            self.line.say(f'{request}: {reply}')
        else:
            self.line.note('executed', cmd1=request.cmd1, cmd2=request.cmd2,
                           data=request.data.hex())
        if reply is not None:
            self._reply(reply, request)

    def _function(self, request: wire.Request, now: float) -> Optional[wire.Reply]:
        """The reply, or None if it is sent when the motion ends."""
        if request.cmd2 == wire.ENVIRONMENT:
            if request.data:
                return _error(wire.MALFORMED)
            return wire.Reply(wire.OK, self.environment(now).pack())
        if request.cmd2 in self._custom:
            return self._custom_function(self._custom[request.cmd2], request, now)
        if request.cmd2 == wire.ANNOUNCEMENT.number and self._chunks:
            if len(request.data) != 1 or request.data[0] >= len(self._chunks):
                return _error(wire.MALFORMED)
            return wire.Reply(wire.OK, self._chunks[request.data[0]].pack())
        if request.cmd2 == MEMORY:
            self.memory = request.data
            return wire.Reply(wire.OK, request.data)
        if request.cmd2 not in (wire.LIFT, wire.GIMBAL):
            return _error(wire.UNSUPPORTED)
        directions = wire.BUILT_IN[request[:2]].directions
        if len(request.data) != 2 or request.data[0] >= len(directions):
            return _error(wire.MALFORMED)
        direction, amount = request.data
        if request.cmd2 == wire.LIFT:
            axis, name, unit, sign = self.lift, 'lift', ' mm', -1 if direction else 1
        elif direction < 2:
            axis, name, unit, sign = self.pan, 'pan', '°', -1 if direction else 1
        else:
            axis, name, unit, sign = self.tilt, 'tilt', '°', 1 if direction == 2 else -1
        distance = sign * amount
        if not axis.allows(distance, now):
            return _error(wire.OPERATION_FAILED)
        start = axis.at(now)
        self._motion = _Motion(axis.move(distance, now), request)
        self.line.say(f'{name}: {directions[direction]} {amount}{unit}: {round(start, 1):g} -> '
                      f'{round(start + distance, 1):g}{unit}')
        return None

    def _custom_function(self, function: wire.Function, request: wire.Request,
                         now: float) -> wire.Reply:
        if not function.layout.fits(len(request.data)):
            return _error(wire.MALFORMED)
        values = function.layout.unpack(request.data)
        if function.layout.implausible(values):
            return _error(wire.OPERATION_FAILED)
        self.line.say(f'{function.name} {function.layout.text(values)}'.rstrip())
        return wire.Reply(wire.OK, function.reply.pack(simulated_values(function.reply, now)))

    def environment(self, now: float) -> wire.Environment:
        """What the environment sensors measure."""
        gauss = self._random.gauss
        return wire.Environment(
            round(130 + 15 * math.sin(now / 40) + gauss(0, 2)),
            round(22 + 1.5 * math.sin(now / 90) + gauss(0, 0.02), 2),
            round(45 + 4 * math.sin(now / 130 + 1) + gauss(0, 0.05), 2))

    # -- inside ---------------------------------------------------------------------------

    def _reply(self, reply: wire.Reply, request: Optional[wire.Request] = None) -> None:
        self._owes_invalid = False
        if request is not None:
            reply = reply._replace(cmd2=request.cmd2)
        self.line.send(wire.encode_reply(reply, self._reply_has_cmd2))


def _invalid(code: int) -> wire.Reply:
    return wire.Reply(wire.INVALID, bytes((code,)))


def _error(code: int) -> wire.Reply:
    return wire.Reply(wire.ERROR, code.to_bytes(2, 'little'))


BOARD = ControlBoard
