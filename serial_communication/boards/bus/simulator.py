"""The simulated main control board: lift, gimbal and air, Slave on a robot-ctrl-bus.

It answers every valid request once, in order, and does nothing unasked. While a motion lasts it
takes requests in and answers them afterwards, as a board with one loop does.

What it says to a request that is damaged is a matter of safety: INVALID tells the Master that
nothing was executed, so it sends the request again. Noise can look like a damaged frame and have
a valid request right behind it; to answer INVALID and then execute that would move a lift twice.
So INVALID goes out only for what has a frame's form and a wrong checksum, and only when the line
then stayed quiet for `FRAME_TIMEOUT` without a valid request; noise and frames cut short get no
answer, nor does what trails a valid request: the Master's timeout deals with them.

    function     range                       speed                     refused with
    lift         0 … 1000 mm, starts at 500  100 mm/s                  0x8002 beyond the range
    gimbal pan   -180 … 180°, left is +      90 °/s                    0x8002 beyond the range
    gimbal tilt  -45 … 90°, up is +          90 °/s                    0x8002 beyond the range
    environment  drifts about 130 raw, 22 °C, 45 %
    0x55 0xF0    keeps its DATE in a memory of its own and answers OK with the same DATE: a
                 function that no bridge knows, to try raw requests on
"""
import argparse
import math
from collections import deque
from random import Random
from typing import Any, Deque, Iterable, NamedTuple, Optional, Tuple

from ...framing.stream import CHECKSUM, Frame
from ...simulation.board import FRAME_TIMEOUT, Board, positive
from ...simulation.custom_messages import wandering
from . import DESCRIPTION, wire
from .functions import CustomFunction

MEMORY = 0xF0            # CMD2 of the function that a bridge does not know
LIFT_RANGE = (0, 1000)   # mm
LIFT_START = 500
PAN_RANGE = (-180, 180)  # degrees
TILT_RANGE = (-45, 90)
LIFT_SPEED = 100.0       # mm/s
GIMBAL_SPEED = 90.0      # degrees/s

_QUOTED = 64             # bytes that the journal has of what is no valid request
_MOST_QUEUED = 16        # requests that wait while a motion lasts; more are lost


class Axis:
    """Something that moves at an even speed between two limits."""

    def __init__(self, position: float, limits: Tuple[float, float], speed: float) -> None:
        self.limits = limits
        self.speed = speed
        self._from = self._to = float(position)
        self._since = 0.0

    def at(self, now: float) -> float:
        """Its position."""
        way = self._to - self._from
        gone = min(max(now - self._since, 0.0) * self.speed, abs(way))
        return self._from + math.copysign(gone, way)

    def allows(self, way: float, now: float) -> bool:
        """Whether it can move by that much."""
        return self.limits[0] <= round(self.at(now) + way, 6) <= self.limits[1]

    def move(self, way: float, now: float) -> float:
        """Begin to move by `way`; return when it will be there."""
        self._from = self.at(now)
        self._to = self._from + way
        self._since = now
        return now + abs(way) / self.speed

    def halt(self, now: float) -> None:
        """Stay where it is."""
        self._from = self._to = self.at(now)


class _Motion(NamedTuple):
    """What is being executed."""

    until: float
    number: int       # of the request
    request: wire.Request


class ControlBoard(Board):
    """See the module.

    Args:
        lift_speed, gimbal_speed: mm/s and degrees/s.
        max_length: DATE bytes; a longer request is refused with 0x20, but one that says it is
            longer than the protocol's 1024, too, is no frame.
        reply_has_cmd2: replies carry their request's CMD2.
        echoes: whether it answers ECHO at all.
        ok_data: DATE bytes that its OK to a move carries.
        seed: of the air's noise.
        own: functions of one's own: it answers with values that wander.
    """

    NAME = DESCRIPTION.name
    SUMMARY = 'main control board: lift, gimbal, air'
    FAULTS = ('drop=0.01 cut=0.01 lose=0.01 flip=0.01 insert=0.01 double=0.01 repeat=0.01 '
              'delay=0.01 late=0.005 rx-drop=0.005 rx-lose=0.005 rx-flip=0.01 rx-insert=0.005 '
              'silence=0.5/min stall=0.5/min reset=0.5/min')
    CHATTER = b'\r\nboot 1.4\r\nRAM ok\r\nlift: ok gimbal: ok\r\n'

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument('--lift-speed', type=positive, default=LIFT_SPEED, metavar='MM/S',
                            help='how fast the lift moves (%(default)g)')
        parser.add_argument('--gimbal-speed', type=positive, default=GIMBAL_SPEED,
                            metavar='DEG/S', help='how fast the gimbal turns (%(default)g)')
        parser.add_argument('--max-length', type=_length, default=wire.MAX_LENGTH, metavar='N',
                            help='longest DATE that it accepts (%(default)d)')
        parser.add_argument('--reply-has-cmd2', action='store_true',
                            help="replies carry their request's CMD2")
        parser.add_argument('--no-echo', action='store_true', help='never answer ECHO')
        parser.add_argument('--ok-data', type=bytes.fromhex, default=b'', metavar='HEX',
                            help='data in the OK to a move, as 0102')

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> 'ControlBoard':
        return cls(options.lift_speed, options.gimbal_speed, options.max_length,
                   options.reply_has_cmd2, options.seed, not options.no_echo, options.ok_data,
                   options.config)

    def __init__(self, lift_speed: float = LIFT_SPEED, gimbal_speed: float = GIMBAL_SPEED,
                 max_length: int = wire.MAX_LENGTH, reply_has_cmd2: bool = False,
                 seed: int = 0, echoes: bool = True, ok_data: bytes = b'',
                 own: Iterable[CustomFunction] = ()) -> None:
        super().__init__(wire.RequestDecoder(max(wire.MAX_LENGTH, max_length)))
        self._own = {function.cmd2: function for function in own}
        self.lift = Axis(LIFT_START, LIFT_RANGE, lift_speed)
        self.pan = Axis(0, PAN_RANGE, gimbal_speed)
        self.tilt = Axis(0, TILT_RANGE, gimbal_speed)
        self.memory = b''
        self.synchronised = False
        self.requests = 0       # valid and damaged ones
        self.executed = 0
        self._max_length = max_length
        self._reply_has_cmd2 = reply_has_cmd2
        self._echoes = echoes
        self._ok_data = ok_data
        self._random = Random(f'{seed} air')
        self._motion: Optional[_Motion] = None
        self._queue: Deque[Tuple[int, Frame]] = deque()
        self._complaint = 0     # the damaged request that INVALID is to be said to; 0: none
        self._valid = False     # a valid request came with, or just before, these bytes

    # -- hooks ----------------------------------------------------------------------------

    def power_on(self, now: float) -> None:
        self.decoder.reset()
        self.synchronised = False
        self.memory = b''
        self._motion = None
        self._queue.clear()
        self._complaint = 0
        self._valid = False

    def power_off(self, now: float) -> None:
        for axis in (self.lift, self.pan, self.tilt):
            axis.halt(now)

    def receive(self, data: bytes, now: float) -> None:
        if not self.decoder.begun:
            self._valid = False    # what comes from now on has nothing to do with what was
        super().receive(data, now)

    def frame(self, frame: Frame, now: float) -> None:
        self.requests += 1
        number = self.requests
        if frame.cause:
            self.note('request', k=number, raw=frame.raw[:_QUOTED].hex(), sound=False,
                      cause=frame.cause, error=frame.error)
            if frame.cause == CHECKSUM and not self._valid and not self._motion:
                self._complaint = number
            return
        self._valid = True
        self._complaint = 0
        self.note('request', k=number, raw=frame.raw.hex(), sound=True,
                  text=f'{frame.message}', **self._genuine(frame))
        if self._motion is None:
            self._serve(number, frame, now)
        elif len(self._queue) < _MOST_QUEUED:
            self._queue.append((number, frame))
        else:
            self.note('rx-lost', data=frame.raw.hex(), why='too many requests while moving')

    def advance(self, now: float) -> Optional[float]:
        motion = self._motion
        if motion and now >= motion.until:
            self._motion = None
            self.note('done', k=motion.number, lift=round(self.lift.at(now), 1),
                      pan=round(self.pan.at(now), 1), tilt=round(self.tilt.at(now), 1))
            self._reply(motion.number, wire.Reply(wire.OK, self._ok_data), motion.request)
        while self._queue and self._motion is None:
            number, frame = self._queue.popleft()
            self._serve(number, frame, now)
        if self._motion:
            return self._motion.until
        if self._complaint:
            quiet = self._last_byte + FRAME_TIMEOUT
            if now < quiet:
                return quiet
            self.say('a request came damaged; answering INVALID')
            self._reply(self._complaint, _invalid(wire.CHECKSUM_MISMATCH))
        return None

    def fields(self, frame: bytes, message: Any) -> dict:
        number, reply = message
        return {'k': number, 'raw': frame.hex(), 'text': f'{reply}'}

    # -- requests -------------------------------------------------------------------------

    def _serve(self, number: int, frame: Frame, now: float) -> None:
        request = frame.message
        if len(request.data) > self._max_length:
            reply = _invalid(wire.TOO_LONG)
        elif request.cmd1 == wire.SYNC:
            if not self.synchronised:
                self.say('synchronised')
            self.synchronised = True
            reply = wire.Reply(wire.SYNC)
        elif not self.synchronised:
            reply = _invalid(wire.NOT_SYNCHRONISED)
        elif request.cmd1 == wire.ECHO:
            reply = wire.Reply(wire.ECHO, request.data) if self._echoes else None
        elif request.cmd1 == wire.FUNCTION:
            reply = self._function(number, request, now)
        else:
            reply = _error(wire.UNSUPPORTED)
        if reply is not None and reply.cmd1 in (wire.ERROR, wire.INVALID):
            self.say(f'{request}: {reply}')
        else:
            self.executed += 1
            self.note('executed', n=self.executed, k=number, raw=frame.raw.hex(),
                      cmd1=request.cmd1, cmd2=request.cmd2, data=request.data.hex(),
                      text=f'{request}', **self._genuine(frame))
        if reply is not None:
            self._reply(number, reply, request)

    def _function(self, number: int, request: wire.Request, now: float) -> Optional[wire.Reply]:
        """The reply, or None if it follows when the motion has ended."""
        if request.cmd2 == wire.ENVIRONMENT:
            if request.data:
                return _error(wire.MALFORMED)
            return wire.Reply(wire.OK, self.air(now).pack())
        if request.cmd2 in self._own:
            return self._own_function(self._own[request.cmd2], request, now)
        if request.cmd2 == MEMORY:
            self.memory = request.data
            return wire.Reply(wire.OK, request.data)
        if request.cmd2 not in (wire.LIFT, wire.GIMBAL):
            return _error(wire.UNSUPPORTED)
        directions = wire.LIFT_DIRECTIONS if request.cmd2 == wire.LIFT else wire.GIMBAL_DIRECTIONS
        if len(request.data) != 2 or request.data[0] >= len(directions):
            return _error(wire.MALFORMED)
        direction, amount = request.data
        if request.cmd2 == wire.LIFT:
            axis, name, unit, way = self.lift, 'lift', ' mm', -amount if direction else amount
        elif direction < 2:
            axis, name, unit, way = self.pan, 'pan', '°', -amount if direction else amount
        else:
            axis, name, unit, way = self.tilt, 'tilt', '°', amount if direction == 2 else -amount
        if not axis.allows(way, now):
            return _error(wire.OPERATION_FAILED)
        start = axis.at(now)
        self._motion = _Motion(axis.move(way, now), number, request)
        self.say(f'{name}: {directions[direction]} {amount}{unit}: {round(start, 1):g} -> '
                 f'{round(start + way, 1):g}{unit}')
        return None

    def _own_function(self, own: CustomFunction, request: wire.Request, now: float) -> wire.Reply:
        if not own.request.fits(len(request.data)):
            return _error(wire.MALFORMED)
        values = own.request.unpack(request.data)
        if own.request.implausible(values):
            return _error(wire.OPERATION_FAILED)
        self.say(f'{own.name} {own.request.text(values)}'.rstrip())
        return wire.Reply(wire.OK, own.reply.pack(wandering(own.reply, now)))

    def air(self, now: float) -> wire.Environment:
        """What the sensors measure."""
        gauss = self._random.gauss
        return wire.Environment(
            round(130 + 15 * math.sin(now / 40) + gauss(0, 2)),
            round(22 + 1.5 * math.sin(now / 90) + gauss(0, 0.02), 2),
            round(45 + 4 * math.sin(now / 130 + 1) + gauss(0, 0.05), 2))

    # -- inside ---------------------------------------------------------------------------

    def _reply(self, number: int, reply: wire.Reply,
               request: Optional[wire.Request] = None) -> None:
        self._complaint = 0
        if request is not None:
            reply = reply._replace(cmd2=request.cmd2)
        self.send(wire.encode_reply(reply, self._reply_has_cmd2),
                  (number if request is not None else 0, reply))

    def _genuine(self, frame: Frame) -> dict:
        return {} if self.line.came(frame.raw) else {'genuine': False}


def _invalid(code: int) -> wire.Reply:
    return wire.Reply(wire.INVALID, bytes((code,)))


def _error(code: int) -> wire.Reply:
    return wire.Reply(wire.ERROR, code.to_bytes(2, 'little'))


def _length(text: str) -> int:
    value = int(text)
    if not 0 < value <= wire.MAX_LENGTH:
        raise argparse.ArgumentTypeError(f'{text} is not 1 to {wire.MAX_LENGTH}')
    return value


BOARD = ControlBoard
