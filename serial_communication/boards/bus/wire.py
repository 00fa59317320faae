"""robot-ctrl-bus over RS232: one Master sends requests, one Slave replies. Both directions.

    request  +------+---------+------+------+--------+----------+
             | Flag | Datelen | CMD1 | CMD2 | DATE … | Checksum |
             +------+---------+------+------+--------+----------+
    reply    +------+---------+------+--------+----------+
             | Flag | Datelen | CMD1 | DATE … | Checksum |
             +------+---------+------+--------+----------+

Flag 0xA5: standard frame, Datelen is one byte, under 255. Flag 0x5A: long frame, Datelen is a
uint16, 255 or more. Datelen counts the DATE bytes. Checksum: XOR of every byte before it.
Little-endian. doc/protocols.md lists the decisions where the source says nothing.
"""
from typing import Any, Iterable, List, NamedTuple, Optional, Union

from ...framing.layout import Layout, Value
from ...framing.parts import Part, Parts
from ...framing.stream import CHECKSUM, NO_FRAME, Bad, Good, Need, StreamDecoder, running_xor

STANDARD_FLAG = 0xA5
LONG_FLAG = 0x5A
MAX_LENGTH = 1024      # most DATE bytes accepted

# CMD1 of a request; a SYNC or ECHO reply has the same.
SYNC = 0x00
ECHO = 0x01
FUNCTION = 0x55        # CMD2 says which
# CMD1 of a reply
OK = 0x02              # executed
ERROR = 0x03           # understood, and failed
INVALID = 0xFF         # the frame was not accepted, nothing was executed
# CMD2
LIFT = 0x20
GIMBAL = 0x21
ENVIRONMENT = 0x22
# error codes
CHECKSUM_MISMATCH = 0x40
TOO_LONG = 0x20
NOT_SYNCHRONISED = 0x10
UNSUPPORTED = 0x8000
MALFORMED = 0x8001
OPERATION_FAILED = 0x8002

ERROR_TEXTS = {
    CHECKSUM_MISMATCH: 'the checksum did not match',
    TOO_LONG: 'the frame was too long for the board',
    NOT_SYNCHRONISED: 'the channel is not synchronised',
    UNSUPPORTED: 'the board does not support this command',
    MALFORMED: 'the data is malformed',
    OPERATION_FAILED: 'the operation failed',
}

LIFT_DIRECTIONS = ('up', 'down')
GIMBAL_DIRECTIONS = ('left', 'right', 'up', 'down')

NO_DATA = Layout('<', ())     # layout of an empty DATE

_MOVES = {
    LIFT: ('lift', LIFT_DIRECTIONS, Value('distance', 'mm')),
    GIMBAL: ('gimbal', GIMBAL_DIRECTIONS, Value('angle', 'degrees')),
}
_FUNCTION_NAMES = {LIFT: 'lift', GIMBAL: 'gimbal', ENVIRONMENT: 'environment'}
_REQUEST_NAMES = {SYNC: 'SYNC', ECHO: 'ECHO', FUNCTION: 'function'}
_REPLY_NAMES = {SYNC: 'SYNC', ECHO: 'ECHO', OK: 'OK', ERROR: 'ERROR', INVALID: 'INVALID'}


class Request(NamedTuple):
    """A request of the Master. See also `lift`, `gimbal`, `echo` and the constants below."""

    cmd1: int
    cmd2: int = 0
    data: bytes = b''

    def __str__(self) -> str:
        data = self.data
        if self.cmd1 == SYNC:
            return 'SYNC'
        if self.cmd1 == ECHO:
            return f'ECHO {data.hex()}'
        if self.cmd1 == FUNCTION:
            if self.cmd2 == ENVIRONMENT and not data:
                return 'environment?'
            if self.cmd2 in _MOVES and len(data) == 2:
                name, directions, amount = _MOVES[self.cmd2]
                if data[0] < len(directions):
                    return f'{name} {directions[data[0]]} {data[1]} {amount.unit}'
        return f'request 0x{self.cmd1:02x} 0x{self.cmd2:02x} {data.hex()}'


class Reply(NamedTuple):
    """A reply of the Slave."""

    cmd1: int
    data: bytes = b''
    cmd2: int = 0     # only where replies carry one

    @property
    def error_code(self) -> int:
        """The code in an ERROR or INVALID, one or two bytes long; 0 if there is none."""
        if self.cmd1 in (ERROR, INVALID):
            return int.from_bytes(self.data[:2], 'little')
        return 0

    def __str__(self) -> str:
        name = _REPLY_NAMES.get(self.cmd1, f'reply 0x{self.cmd1:02x}')
        if self.cmd1 in (ERROR, INVALID):
            return f'{name} {describe_error(self.error_code)}'
        if self.cmd1 == OK and len(self.data) == Environment.LAYOUT.size:
            return f'OK {self.data.hex()} (if environment: {Environment.unpack(self.data)})'
        return f'{name} {self.data.hex()}'.rstrip()


class NamedRequest(Request):
    """A request of a custom function; its text has the function's name."""

    text = ''
    function: Any = None     # the CustomFunction

    def __str__(self) -> str:
        return self.text


class NamedReply(Reply):
    """The OK to a custom function; its text has the function's name."""

    text = ''

    def __str__(self) -> str:
        return self.text


class _EnvironmentValues(NamedTuple):
    smoke: int          # raw, 0 … 65535
    temperature: float  # °C, in steps of 0.01
    humidity: float     # relative, %, in steps of 0.01


class Environment(_EnvironmentValues):
    """The DATE of an OK reply to the environment request."""

    __slots__ = ()
    LAYOUT = Layout('<HhH', [Value('smoke'), Value('temperature', '°C', 0.01),
                             Value('humidity', '%', 0.01)])

    @classmethod
    def unpack(cls, data: bytes) -> 'Environment':
        """From six DATE bytes; struct.error if there are more or fewer."""
        smoke, temperature, humidity = cls.LAYOUT.raw(data)
        return cls(smoke, temperature / 100, humidity / 100)

    def pack(self) -> bytes:
        """The six DATE bytes."""
        return self.LAYOUT.pack_raw((self.smoke, round(self.temperature * 100),
                                     round(self.humidity * 100)))

    @classmethod
    def parts(cls, data: bytes) -> List[Part]:
        """The values of the DATE, each with its bytes."""
        return cls.LAYOUT.parts(data, cls.unpack)

    def __str__(self) -> str:
        return f'smoke {self.smoke}, {self.temperature:.2f} C, {self.humidity:.2f} %'


SYNC_REQUEST = Request(SYNC)
ENVIRONMENT_REQUEST = Request(FUNCTION, ENVIRONMENT)


def lift(direction: int, distance: int) -> Request:
    """A relative move of the lift: direction 0 up, 1 down; distance 0 … 255 mm.

    Raises:
        ValueError: a value is out of its range.
    """
    return _move(LIFT, direction, distance)


def gimbal(direction: int, angle: int) -> Request:
    """A relative turn of the gimbal: 0 left, 1 right, 2 up, 3 down; angle 0 … 255 degrees.

    Raises:
        ValueError: a value is out of its range.
    """
    return _move(GIMBAL, direction, angle)


def echo(data: bytes) -> Request:
    """A request that the board answers with the same `data`."""
    return Request(ECHO, 0, data)


def _move(cmd2: int, direction: int, amount: int) -> Request:
    name, directions, value = _MOVES[cmd2]
    if not 0 <= direction < len(directions):
        choices = ', '.join(f'{number} ({each})' for number, each in enumerate(directions))
        raise ValueError(f'{name}: direction is {direction}, may be {choices}')
    if not 0 <= amount <= 255:
        raise ValueError(f'{name}: {value.name} is {amount} {value.unit}, may be 0 to 255')
    return Request(FUNCTION, cmd2, bytes((direction, amount)))


def describe_error(code: int) -> str:
    """An error code as a number and in words."""
    return f'0x{code:02x}: {ERROR_TEXTS.get(code, "not a code of the protocol")}'


def encode_request(request: Request, environment_datelen: int = 2) -> bytes:
    """The frame of a request.

    Args:
        environment_datelen: Datelen of an environment request, which has no DATE: 2 as its source
            documents it, or 0.

    Raises:
        ValueError: there are more than `MAX_LENGTH` DATE bytes.
    """
    header = bytes((request.cmd1, request.cmd2))
    if request == ENVIRONMENT_REQUEST:
        return _seal(bytes((STANDARD_FLAG, environment_datelen)) + header)
    return _frame(header, request.data)


def encode_reply(reply: Reply, has_cmd2: bool = False) -> bytes:
    """The frame of a reply, with CMD2 if `has_cmd2`.

    Raises:
        ValueError: there are more than `MAX_LENGTH` DATE bytes.
    """
    return _frame(bytes((reply.cmd1, reply.cmd2) if has_cmd2 else (reply.cmd1,)), reply.data)


def _frame(commands: bytes, data: bytes) -> bytes:
    size = len(data)
    if size > MAX_LENGTH:
        raise ValueError(f'data is {size} bytes long, may be at most {MAX_LENGTH}')
    if size < 255:
        start = bytes((STANDARD_FLAG, size))
    else:
        start = bytes((LONG_FLAG, size & 0xFF, size >> 8))
    return _seal(start + commands + data)


def _seal(frame: bytes) -> bytes:
    return frame + running_xor(frame, 0)[-1:]


class _Decoder(StreamDecoder):
    """Base of both directions, which differ in the number of CMD bytes and the typed message."""

    STARTS = bytes((STANDARD_FLAG, LONG_FLAG))
    _commands = 1  # CMD bytes
    _NAMES = _REPLY_NAMES      # the names of CMD1

    def __init__(self, max_length: int = MAX_LENGTH, functions: Iterable[Any] = ()) -> None:
        super().__init__()
        self._max_length = max_length
        self._functions = {function.cmd2: function for function in functions}

    def _good(self, size: int, commands: bytes, data: bytes) -> Good:
        raise NotImplementedError

    def _explain_data(self, cmd1: int, cmd2: int, data: bytes,
                      request: Optional[Request]) -> List[Part]:
        """The parts of the DATE."""
        return [Part(0, len(data), 'DATE', data)] if data else []

    def _short_end(self, frame: bytes) -> int:
        """The size of the valid frame at the start if it is shorter than its Datelen, else 0."""
        return 0

    def explain(self, frame: bytes, request: Optional[Request] = None) -> List[Part]:
        """The named parts of one frame, valid or not, incomplete, or of noise.

        Args:
            frame: its bytes, as many as there are.
            request: the request that a reply answers, if known; it says what the DATE means.
        """
        parts = Parts(frame)
        flag = frame[:1]
        if flag not in (bytes((STANDARD_FLAG,)), bytes((LONG_FLAG,))):
            return parts.take_rest('noise', 'no frame begins with these bytes')
        is_long = flag[0] == LONG_FLAG
        header = 3 if is_long else 2
        parts.take(1, 'Flag', 'long frame' if is_long else 'standard frame')
        length = int.from_bytes(frame[1:header], 'little')
        least, most = (255, self._max_length) if is_long else (0, min(254, self._max_length))
        is_invalid = parts.left >= header - 1 and not least <= length <= most
        is_short = bool(self._short_end(frame))
        parts.take(header - 1, 'Datelen', 'an environment request has no DATE' if is_short
                   else 'bytes of DATE', f'may be {least} to {most}' if is_invalid else '')
        if is_invalid:
            return parts.take_rest('noise', 'bytes after an invalid Datelen')
        if is_short:
            length = 0
        cmd1, cmd2 = parts.take_kind('CMD1', self._NAMES), 0
        if self._commands > 1 and cmd1 == FUNCTION:
            cmd2 = parts.take_kind('CMD2', {
                **_FUNCTION_NAMES, **{n: f.name for n, f in self._functions.items()}})
        elif self._commands > 1:
            cmd2 = parts.take(1, 'CMD2')
        parts.take_data(length, lambda data: self._explain_data(cmd1, cmd2, data, request))
        parts.take_checksum('Checksum', frame[:parts.at])
        return parts.take_rest('noise', 'bytes after the frame')

    def frame_at(self, at: int) -> Union[Good, Bad, Need]:
        buffer = self.buffer
        left = len(buffer) - at
        if buffer[at] == STANDARD_FLAG:
            if left < 2:
                return Need(2)
            header, length = 2, buffer[at + 1]
            is_invalid = length >= 255
        else:
            if left < 3:
                return Need(3)
            header, length = 3, buffer[at + 1] | buffer[at + 2] << 8
            is_invalid = length < 255
        if is_invalid or length > self._max_length:
            return NO_FRAME
        size = header + self._commands + length + 1
        if left < size:
            return Need(size)
        end = at + size
        if self.xor(at, end):
            return Bad(size, CHECKSUM, 'the checksum does not match')
        data_at = end - 1 - length
        return self._good(size, buffer[at + header:data_at], buffer[data_at:end - 1])


class ReplyDecoder(_Decoder):
    """Decodes replies, Slave -> Master.

    Args:
        has_cmd2: whether replies carry a CMD2.
        max_length: most DATE bytes accepted.
        functions: custom functions, which `explain` shows by name.
    """

    def __init__(self, has_cmd2: bool = False, max_length: int = MAX_LENGTH,
                 functions: Iterable[Any] = ()) -> None:
        super().__init__(max_length, functions)
        self._commands = 2 if has_cmd2 else 1

    def _good(self, size: int, commands: bytes, data: bytes) -> Good:
        reply = Reply(commands[0], data, commands[1] if len(commands) > 1 else 0)
        return Good(size, reply.cmd1, 0, data, reply)

    def _explain_data(self, cmd1: int, cmd2: int, data: bytes,
                      request: Optional[Request]) -> List[Part]:
        if cmd1 in (ERROR, INVALID) and len(data) in (1, 2):
            code = int.from_bytes(data, 'little')
            return [Part(0, len(data), 'error code', data, code, code,
                         meaning=ERROR_TEXTS.get(code, 'not a code of the protocol'))]
        if cmd1 == OK and request and request.cmd2 in self._functions:
            return self._functions[request.cmd2].reply.parts(data)
        if cmd1 == OK and (request == ENVIRONMENT_REQUEST if request
                           else len(data) == Environment.LAYOUT.size):
            return [part if request else part._replace(meaning='if it is an environment reply')
                    for part in Environment.parts(data)]
        return super()._explain_data(cmd1, cmd2, data, request)


class RequestDecoder(_Decoder):
    """Decodes requests, Master -> Slave. Datelen of an environment request may be 2 or 0."""

    _commands = 2
    _NAMES = _REQUEST_NAMES
    _ENVIRONMENT = encode_request(ENVIRONMENT_REQUEST)

    def _good(self, size: int, commands: bytes, data: bytes) -> Good:
        return Good(size, commands[0], commands[1], data, Request(commands[0], commands[1], data))

    def frame_at(self, at: int) -> Union[Good, Bad, Need]:
        begun = self.buffer[at:at + len(self._ENVIRONMENT)]
        if begun == self._ENVIRONMENT:
            return self._good(len(begun), begun[2:4], b'')
        found = super().frame_at(at)
        if isinstance(found, Need) and self._ENVIRONMENT.startswith(begun):
            return Need(len(begun) + 1)
        return found

    def _explain_data(self, cmd1: int, cmd2: int, data: bytes,
                      request: Optional[Request]) -> List[Part]:
        if cmd1 == FUNCTION and cmd2 in self._functions:
            return self._functions[cmd2].request.parts(data)
        if cmd1 != FUNCTION or cmd2 not in _MOVES:
            return super()._explain_data(cmd1, cmd2, data, request)
        _, directions, amount = _MOVES[cmd2]
        parts = Layout('<BB', [Value('direction', maximum=len(directions) - 1),
                               amount]).parts(data)
        if parts[0].raw is not None and not parts[0].error:
            parts[0] = parts[0]._replace(meaning=directions[parts[0].raw])
        return parts

    def _short_end(self, frame: bytes) -> int:
        return len(self._ENVIRONMENT) if frame[:5] == self._ENVIRONMENT else 0
