"""robot-ctrl-bus: one Master asks, one Slave answers, over RS232. Both directions.

    request  +------+---------+------+------+--------+----------+
             | Flag | Datelen | CMD1 | CMD2 | DATE … | Checksum |
             +------+---------+------+------+--------+----------+
    reply    +------+---------+------+--------+----------+
             | Flag | Datelen | CMD1 | DATE … | Checksum |
             +------+---------+------+--------+----------+

Flag 0xA5: standard frame, Datelen is one byte, under 255. Flag 0x5A: long frame, Datelen is a
uint16, 255 or more. Datelen counts the DATE bytes. Checksum: XOR of every byte before it.
Little-endian. Decisions where the source is silent: see "Protocols" in README.md.
"""
import re
from struct import Struct
from typing import Any, NamedTuple

from .framing import CHECKSUM, FRAMING, StreamDecoder, running_xor

STANDARD_FLAG = 0xA5
LONG_FLAG = 0x5A
_FLAG = re.compile(b'[%c%c]' % (STANDARD_FLAG, LONG_FLAG))
MAX_LENGTH = 1024      # most DATE bytes accepted

# CMD1 of a request; a SYNC or ECHO reply has the same.
SYNC = 0x00
ECHO = 0x01
FUNCTION = 0x55        # what function: CMD2
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

_new = tuple.__new__
_REPLY_NAMES = {SYNC: 'SYNC', ECHO: 'ECHO', OK: 'OK', ERROR: 'ERROR', INVALID: 'INVALID'}


class Request(NamedTuple):
    """What the Master asks. `lift`, `gimbal` and the constants below make the known ones."""

    cmd1: int
    cmd2: int = 0
    data: bytes = b''

    def __str__(self) -> str:
        data = self.data
        if self.cmd1 == SYNC:
            return 'SYNC'
        if self.cmd1 == ECHO:
            return 'ECHO %s' % data.hex()
        if self.cmd1 == FUNCTION:
            if self.cmd2 == ENVIRONMENT and not data:
                return 'environment?'
            for name, cmd2, directions, unit in (
                    ('lift', LIFT, LIFT_DIRECTIONS, 'mm'),
                    ('gimbal', GIMBAL, GIMBAL_DIRECTIONS, 'degrees')):
                if self.cmd2 == cmd2 and len(data) == 2 and data[0] < len(directions):
                    return '%s %s %d %s' % (name, directions[data[0]], data[1], unit)
        return 'request 0x%02x 0x%02x %s' % (self.cmd1, self.cmd2, data.hex())


class Reply(NamedTuple):
    """What the Slave answers."""

    cmd1: int
    data: bytes = b''
    cmd2: int = 0     # only where replies carry one

    @property
    def error_code(self) -> int:
        """Of an ERROR or INVALID, one or two bytes long; 0 where there is none."""
        if self.cmd1 in (ERROR, INVALID):
            return int.from_bytes(self.data[:2], 'little')
        return 0

    def __str__(self) -> str:
        name = _REPLY_NAMES.get(self.cmd1, 'reply 0x%02x' % self.cmd1)
        if self.cmd1 in (ERROR, INVALID):
            return '%s %s' % (name, describe_error(self.error_code))
        if self.cmd1 == OK and len(self.data) == Environment.LAYOUT.size:
            return 'OK %s (if environment: %s)' % (self.data.hex(),
                                                   Environment.unpack(self.data))
        return ('%s %s' % (name, self.data.hex())).rstrip()


class Environment(NamedTuple):
    """The DATE of an OK reply to the environment request."""

    LAYOUT = Struct('<HhH')

    smoke: int          # raw, 0 … 65535
    temperature: float  # °C, in steps of 0.01
    humidity: float     # relative, %, in steps of 0.01

    @classmethod
    def unpack(cls, data: bytes) -> 'Environment':
        """From six DATE bytes; struct.error with any other number."""
        smoke, temperature, humidity = cls.LAYOUT.unpack(data)
        return cls(smoke, temperature / 100, humidity / 100)

    def pack(self) -> bytes:
        """The six DATE bytes."""
        return self.LAYOUT.pack(self.smoke, round(self.temperature * 100),
                                round(self.humidity * 100))

    def __str__(self) -> str:
        return 'smoke %d, %.2f C, %.2f %%' % self


SYNC_REQUEST = Request(SYNC)
ENVIRONMENT_REQUEST = Request(FUNCTION, ENVIRONMENT)


def lift(direction: int, distance: int) -> Request:
    """A relative move of the lift: direction 0 up, 1 down; distance 0 … 255 mm.

    Raises:
        ValueError: a value out of its range; the text is for a person.
    """
    return _move(LIFT, LIFT_DIRECTIONS, direction, distance, 'distance', 'mm')


def gimbal(direction: int, angle: int) -> Request:
    """A relative turn of the gimbal: 0 left, 1 right, 2 up, 3 down; angle 0 … 255 degrees.

    Raises:
        ValueError: a value out of its range; the text is for a person.
    """
    return _move(GIMBAL, GIMBAL_DIRECTIONS, direction, angle, 'angle', 'degrees')


def echo(data: bytes) -> Request:
    """A request that the board answers with the same `data`."""
    return Request(ECHO, 0, data)


def _move(cmd2, directions, direction, amount, noun, unit):
    if not 0 <= direction < len(directions):
        raise ValueError('direction is %d, may be %s' % (direction, ', '.join(
            '%d (%s)' % pair for pair in enumerate(directions))))
    if not 0 <= amount <= 255:
        raise ValueError('%s is %d, may be 0 to 255 %s' % (noun, amount, unit))
    return Request(FUNCTION, cmd2, bytes((direction, amount)))


def describe_error(code: int) -> str:
    """An error code in words, with its number."""
    return '0x%02x: %s' % (code, ERROR_TEXTS.get(code, 'not a code the protocol knows'))


def encode_request(request: Request, environment_datelen: int = 2) -> bytes:
    """The request's frame.

    `environment_datelen` stands as Datelen in an environment request, which has no DATE: 2 as
    its source documents it, or 0.

    Raises:
        ValueError: more than `MAX_LENGTH` DATE bytes.
    """
    header = bytes((request.cmd1, request.cmd2))
    if request == ENVIRONMENT_REQUEST:
        return _seal(bytes((STANDARD_FLAG, environment_datelen)) + header)
    return _frame(header, request.data)


def encode_reply(reply: Reply, has_cmd2: bool = False) -> bytes:
    """The reply's frame; with its CMD2 where `has_cmd2`."""
    return _frame(bytes((reply.cmd1, reply.cmd2) if has_cmd2 else (reply.cmd1,)), reply.data)


def _frame(commands: bytes, data: bytes) -> bytes:
    size = len(data)
    if size > MAX_LENGTH:
        raise ValueError('data is %d bytes long, may be at most %d' % (size, MAX_LENGTH))
    if size < 255:
        start = bytes((STANDARD_FLAG, size))
    else:
        start = bytes((LONG_FLAG, size & 0xFF, size >> 8))
    return _seal(start + commands + data)


def _seal(frame: bytes) -> bytes:
    return frame + running_xor(frame, 0)[-1:]


class _Decoder(StreamDecoder):
    """Both directions: they differ in the number of CMD bytes and in the typed message."""

    _commands = 1  # CMD bytes

    def __init__(self, max_length: int = MAX_LENGTH) -> None:
        super().__init__()
        self._max_length = max_length

    def _message(self, commands: bytes, data: bytes) -> Any:
        raise NotImplementedError

    def _command(self, commands: bytes) -> int:
        """What `Frame.command` is to say."""
        return 0

    def _short_end(self, start: int) -> int:
        """The end of a sound frame at `start` that is shorter than its Datelen says, or 0."""
        return 0

    def _search(self, at: int) -> None:
        buffer, xor = self._buffer, self._xor
        size = len(buffer)
        blamed = self._blamed - self._offset
        while at < size:
            flag = buffer[at]
            if flag == STANDARD_FLAG:
                header = 2
            elif flag == LONG_FLAG:
                header = 3
            else:
                start = self._next_flag(at)
                self._noise(at, start)
                at = start
                continue
            if at + header > size:
                return self._keep(at, header)
            if header == 2:
                length = buffer[at + 1]
                fits = length < 255
            else:
                length = buffer[at + 1] | buffer[at + 2] << 8
                fits = length >= 255
            cause = FRAMING
            if not fits or length > self._max_length:
                end, error = at + header, 'Datelen'
            else:
                payload = at + header + self._commands
                end = self._short_end(at) or payload + length + 1
                if end > size:
                    # One byte more may complete a frame that is shorter than it says.
                    return self._keep(at, min(end - at, self._first_look(size - at)))
                if xor[end - 1] == (xor[at - 1] if at else self._before):
                    commands = bytes(buffer[payload - self._commands:payload])
                    data = bytes(buffer[payload:end - 1])
                    message = self._message(commands, data)
                    self._good(at, end, commands[0], self._command(commands), data, message)
                    at = blamed = end
                    continue
                cause, error = CHECKSUM, 'the checksum does not match'
            if at >= blamed:
                self._failed(at, end, cause, error)
                blamed = end
            at += 1
        self._keep(at, 1)

    def _first_look(self, size: int) -> int:
        return 1 << 16

    def _next_flag(self, at: int) -> int:
        found = _FLAG.search(self._buffer, at)
        return found.start() if found else len(self._buffer)


class ReplyDecoder(_Decoder):
    """Slave -> Master. `has_cmd2`: for a board whose replies carry a CMD2."""

    def __init__(self, has_cmd2: bool = False, max_length: int = MAX_LENGTH) -> None:
        super().__init__(max_length)
        self._commands = 2 if has_cmd2 else 1

    def _message(self, commands: bytes, data: bytes) -> Reply:
        return _new(Reply, (commands[0], data, commands[1] if len(commands) > 1 else 0))


class RequestDecoder(_Decoder):
    """Master -> Slave, for boards: takes an environment request with Datelen 2 and with 0."""

    _commands = 2
    _ENVIRONMENT = encode_request(ENVIRONMENT_REQUEST)

    def _message(self, commands: bytes, data: bytes) -> Request:
        return Request(commands[0], commands[1], data)

    def _command(self, commands: bytes) -> int:
        return commands[1]

    def _short_end(self, start: int) -> int:
        end = start + len(self._ENVIRONMENT)
        return end if self._buffer[start:end] == self._ENVIRONMENT else 0

    def _first_look(self, size: int) -> int:
        return 5 if size < 5 else 1 << 16
