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
from collections import namedtuple
from dataclasses import dataclass
from typing import Sequence, Tuple, Union

from ...framing import announcement
from ...framing.layout import Layout, Value, message_class
from ...framing.rows import Kind, Row
from ...framing.stream import (CHECKSUM, IMPLAUSIBLE, LENGTH, Frame, StreamDecoder, frame_of,
                               invalid_frame, running_xor)

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
NOT_SYNCHRONISED = 0x10
UNSUPPORTED = 0x8000
MALFORMED = 0x8001
OPERATION_FAILED = 0x8002

ERROR_TEXTS = {
    CHECKSUM_MISMATCH: 'the checksum did not match',
    0x20: 'the frame was too long for the board',
    NOT_SYNCHRONISED: 'the channel is not synchronised',
    UNSUPPORTED: 'the board does not support this command',
    MALFORMED: 'the data is malformed',
    OPERATION_FAILED: 'the operation failed',
}
REQUEST_NAMES = {SYNC: 'SYNC', ECHO: 'ECHO', FUNCTION: 'function'}
REPLY_NAMES = {SYNC: 'SYNC', ECHO: 'ECHO', OK: 'OK', ERROR: 'ERROR', INVALID: 'INVALID'}

ANY_DATA = Layout('<B*', [Value('DATE')])


class Request(namedtuple('Request', 'cmd1 cmd2 data', defaults=(0, b''))):
    """A request of the Master."""

    text = ''     # of an own function's: its name and values

    def __str__(self) -> str:
        function = BUILT_IN.get(self[:2])
        return self.text or (
            function.describe(self.data) if function else
            f'request 0x{self.cmd1:02x} 0x{self.cmd2:02x} {self.data.hex()}'.rstrip())


class Reply(namedtuple('Reply', 'cmd1 data cmd2', defaults=(b'', 0))):
    """A reply of the Slave; a CMD2 only where replies carry one."""

    text = ''     # of the OK to such a request

    @property
    def error_code(self) -> int:
        """The code in an ERROR or INVALID, one or two bytes long; 0 if there is none."""
        if self.cmd1 in (ERROR, INVALID):
            return int.from_bytes(self.data[:2], 'little')
        return 0

    def __str__(self) -> str:
        if self.text:
            return self.text
        name = REPLY_NAMES.get(self.cmd1, f'reply 0x{self.cmd1:02x}')
        if self.cmd1 in (ERROR, INVALID):
            return f'{name} {describe_error(self.error_code)}'
        return f'{name} {self.data.hex()}'.rstrip()


# The DATE of an OK reply to the environment request.
Environment = message_class(
    'Environment', ENVIRONMENT, '<HhH', [Value('smoke'), Value('temperature', '°C', 0.01),
                                         Value('humidity', '%', 0.01)], 'environment')


def describe_error(code: int) -> str:
    """An error code as a number and in words."""
    return f'0x{code:02x}: {ERROR_TEXTS.get(code, "not a code of the protocol")}'


# -- functions -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Function(Row):
    """One kind of request, built in or a row of ``bus/functions``, as all parts of the bridge see
    it. doc/protocols.md explains what the flags mean for the Master."""

    kind: Kind = Kind.FUNCTION
    cmd1: int = FUNCTION
    directions: Tuple[str, ...] = ()    # the values of the first byte of a move, in words
    moves: bool = False          # it has the timeout bus/motion_timeout

    def make_request(self, values: Sequence) -> Request:
        """The request with these values; ValueError for one that does not fit, or out of range."""
        reason = self.layout.implausible(values)
        if reason:
            raise ValueError(f'{self.name}: {reason}')
        request = Request(self.cmd1, self.number, self.layout.pack(values))
        if self.key:
            request.text = f'{self.name} {self.layout.text(values)}'.rstrip()
        return request

    def describe(self, data: bytes) -> str:
        """A built-in request with this DATE, in words."""
        if self.directions and len(data) == 2 and data[0] < len(self.directions):
            return f'{self.name} {self.directions[data[0]]} {data[1]} {self.layout.values[1].unit}'
        return f'{self.name} {data.hex()}'.rstrip()

    def data_error(self, reply: Reply) -> Tuple[str, str]:
        """The cause, LENGTH or IMPLAUSIBLE, and what is wrong with the DATE of an OK; '' if nothing
        is. Where none is expected any is right: see rule 5 in doc/protocols.md."""
        size = len(reply.data)
        if reply.cmd1 != OK or self.reply.is_empty:
            return '', ''
        if not self.reply.fits(size):
            return LENGTH, f'{size} bytes of data, {self.reply.sizes()} were expected'
        reason = self.reply.implausible(self.reply.unpack(reply.data))
        return (IMPLAUSIBLE, reason) if reason else ('', '')

    def name_reply(self, reply: Reply) -> Reply:
        """Let the text of an OK with fitting data have the function's name."""
        if reply.cmd1 == OK and self.reply is not ANY_DATA and self.reply.fits(len(reply.data)):
            reply.text = f'{self.name} OK {self.reply.text(self.reply.unpack(reply.data))}'.rstrip()
        return reply


def _move(name: str, cmd2: int, directions: Tuple[str, ...], amount: Value) -> Function:
    layout = Layout('<BB', [Value('direction', minimum=0, maximum=len(directions) - 1), amount])
    return Function(name, cmd2, layout=layout, directions=directions, moves=True,
                    ros_type='serial_communication/' + name.capitalize())


RAW = Function('raw', layout=ANY_DATA, reply=ANY_DATA)    # any request of ~bus/request
SYNC_FUNCTION = Function('SYNC', cmd1=SYNC, reply=ANY_DATA, repeatable=True)
ECHO_FUNCTION = Function('ECHO', cmd1=ECHO, layout=ANY_DATA, reply=ANY_DATA, repeatable=True)
LIFT_FUNCTION = _move('lift', LIFT, ('up', 'down'), Value('distance', 'mm'))
GIMBAL_FUNCTION = _move('gimbal', GIMBAL, ('left', 'right', 'up', 'down'),
                        Value('angle', 'degrees'))
ENVIRONMENT_FUNCTION = Function('environment', ENVIRONMENT, reply=Environment.LAYOUT,
                                repeatable=True)
# Asks for one chunk of the board's announcement.
ANNOUNCEMENT = Function(
    'announcement', announcement.TYPE, layout=Layout('<B', [Value('index')]),
    reply=announcement.Chunk.LAYOUT, repeatable=True, key='bus/announcements')

BUILT_IN = {(function.cmd1, function.number): function for function in (
    SYNC_FUNCTION, ECHO_FUNCTION, LIFT_FUNCTION, GIMBAL_FUNCTION, ENVIRONMENT_FUNCTION,
    ANNOUNCEMENT)}
SYNC_REQUEST = SYNC_FUNCTION.make_request(())
ENVIRONMENT_REQUEST = ENVIRONMENT_FUNCTION.make_request(())


def echo(data: bytes) -> Request:
    """A request that the board answers with the same `data`."""
    return Request(ECHO, 0, data)


# -- frames ---------------------------------------------------------------------------------------


def encode_request(request: Request, environment_datelen: int = 2) -> bytes:
    """The frame of a request; ValueError for more than `MAX_LENGTH` DATE bytes.

    Args:
        environment_datelen: Datelen of an environment request, which has no DATE: 2 as its source
            documents it, or 0.
    """
    header = bytes((request.cmd1, request.cmd2))
    if request == ENVIRONMENT_REQUEST:
        return _seal(bytes((STANDARD_FLAG, environment_datelen)) + header)
    return _frame(header, request.data)


def encode_reply(reply: Reply, has_cmd2: bool = False) -> bytes:
    """The frame of a reply; ValueError for more than `MAX_LENGTH` DATE bytes."""
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
    _commands = 1

    def _whole(self, raw: bytes, commands: bytes, data: bytes) -> Frame:
        raise NotImplementedError

    def frame_at(self, at: int) -> Union[Frame, int, None]:
        buffer = self.buffer
        left = len(buffer) - at
        if buffer[at] == STANDARD_FLAG:
            if left < 2:
                return 2
            header, length = 2, buffer[at + 1]
            is_invalid = length >= 255
        else:
            if left < 3:
                return 3
            header, length = 3, buffer[at + 1] | buffer[at + 2] << 8
            is_invalid = length < 255
        if is_invalid or length > MAX_LENGTH:
            return None
        size = header + self._commands + length + 1
        if left < size:
            return size
        end = at + size
        if self.xor(at, end):
            return invalid_frame(buffer[at:end], CHECKSUM, 'the checksum does not match')
        data_at = end - 1 - length
        return self._whole(buffer[at:end], buffer[at + header:data_at], buffer[data_at:end - 1])


class ReplyDecoder(_Decoder):
    """Decodes replies, Slave -> Master.

    Args:
        has_cmd2: whether replies carry a CMD2.
    """

    def __init__(self, has_cmd2: bool = False) -> None:
        super().__init__()
        self._commands = 2 if has_cmd2 else 1

    def _whole(self, raw: bytes, commands: bytes, data: bytes) -> Frame:
        reply = Reply(commands[0], data, commands[1] if len(commands) > 1 else 0)
        return frame_of((raw, commands[0], 0, data, reply, None, '', '', None, 0))


class RequestDecoder(_Decoder):
    """Decodes requests, Master -> Slave. Datelen of an environment request may be 2 or 0."""

    _commands = 2
    _ENVIRONMENT = encode_request(ENVIRONMENT_REQUEST)

    def _whole(self, raw: bytes, commands: bytes, data: bytes) -> Frame:
        return Frame(raw, commands[0], commands[1], data, Request(commands[0], commands[1], data))

    def frame_at(self, at: int) -> Union[Frame, int, None]:
        begun = self.buffer[at:at + len(self._ENVIRONMENT)]
        if begun == self._ENVIRONMENT:
            return self._whole(begun, begun[2:4], b'')
        found = super().frame_at(at)
        if isinstance(found, int) and self._ENVIRONMENT.startswith(begun):
            return len(begun) + 1
        return found
