"""The messages of robot-ctrl-bus, and the functions that requests call; wire.py has the frames."""
import struct
from dataclasses import dataclass
from typing import NamedTuple, Sequence, Tuple

from ...framing import announcement
from ...framing.layout import EMPTY, Layout, Value
from ...framing.rows import Kind, Row
from ...framing.stream import IMPLAUSIBLE, LENGTH

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
REQUEST_NAMES = {SYNC: 'SYNC', ECHO: 'ECHO', FUNCTION: 'function'}
REPLY_NAMES = {SYNC: 'SYNC', ECHO: 'ECHO', OK: 'OK', ERROR: 'ERROR', INVALID: 'INVALID'}

NO_DATA = EMPTY                      # of an empty DATE
ANY_DATA = Layout('<B*', [Value('DATE')])


class Request(NamedTuple):
    """A request of the Master."""

    cmd1: int
    cmd2: int = 0
    data: bytes = b''

    def __str__(self) -> str:
        if self.cmd1 == SYNC:
            return 'SYNC'
        if self.cmd1 == ECHO:
            return f'ECHO {self.data.hex()}'
        text = built_in(self, RAW).describe(self.data)
        return text or f'request 0x{self.cmd1:02x} 0x{self.cmd2:02x} {self.data.hex()}'


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
        name = REPLY_NAMES.get(self.cmd1, f'reply 0x{self.cmd1:02x}')
        if self.cmd1 in (ERROR, INVALID):
            return f'{name} {describe_error(self.error_code)}'
        if self.cmd1 == OK and len(self.data) == Environment.LAYOUT.size:
            return f'OK {self.data.hex()} (if environment: {Environment.unpack(self.data)})'
        return f'{name} {self.data.hex()}'.rstrip()


class _Named:
    text = ''

    def __str__(self) -> str:
        return self.text


class NamedRequest(_Named, Request):
    """A request of a function that has a key; its text has the function's name."""


class NamedReply(_Named, Reply):
    """The OK to such a request; its text has the function's name."""


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
        return struct.pack(self.LAYOUT.layout, self.smoke, round(self.temperature * 100),
                           round(self.humidity * 100))

    def __str__(self) -> str:
        return f'smoke {self.smoke}, {self.temperature:.2f} C, {self.humidity:.2f} %'


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

    @property
    def cmd2(self) -> int:
        """Its number."""
        return self.number

    @property
    def request(self) -> Layout:
        """The layout of the request's DATE; `reply` is that of the OK's."""
        return self.layout

    def make_request(self, values: Sequence) -> Request:
        """The request with these values; ValueError for one that does not fit, or out of range."""
        reason = self.request.implausible(values)
        if reason:
            raise ValueError(f'{self.name}: {reason}')
        request = (NamedRequest if self.key else Request)(
            self.cmd1, self.cmd2, self.request.pack(values))
        if isinstance(request, NamedRequest):
            request.text = f'{self.name} {self.request.text(values)}'.rstrip()
        return request

    def describe(self, data: bytes) -> str:
        """A built-in request with this DATE in words; '' if it does not fit."""
        if self is ENVIRONMENT_FUNCTION and not data:
            return 'environment?'
        if self.directions and len(data) == 2 and data[0] < len(self.directions):
            return f'{self.name} {self.directions[data[0]]} {data[1]} {self.request.values[1].unit}'
        return ''

    def data_error(self, reply: Reply) -> Tuple[str, str]:
        """The cause, LENGTH or IMPLAUSIBLE, and what is wrong with the DATE of an OK; '' if nothing
        is. Where none is expected any is right: see rule 5 in doc/protocols.md."""
        size = len(reply.data)
        if reply.cmd1 != OK or self.reply.is_empty:
            return '', ''
        if not self.reply.fits(size):
            return LENGTH, f'{size} bytes of data, {self.reply.sizes()} were expected'
        return IMPLAUSIBLE, self.reply.implausible(self.reply.unpack(reply.data))

    def name_reply(self, reply: Reply) -> Reply:
        """The same reply. If the function has a key, the text of an OK with fitting data has the
        function's name."""
        if not self.key or reply.cmd1 != OK or not self.reply.fits(len(reply.data)):
            return reply
        named = NamedReply(*reply)
        named.text = f'{self.name} OK {self.reply.text(self.reply.unpack(reply.data))}'.rstrip()
        return named


def _move(name: str, cmd2: int, directions: Tuple[str, ...], amount: Value) -> Function:
    layout = Layout('<BB', [Value('direction', minimum=0, maximum=len(directions) - 1), amount])
    return Function(name, cmd2, layout=layout, directions=directions, moves=True,
                    ros_type='serial_communication/' + name.capitalize())


RAW = Function('raw', layout=ANY_DATA, reply=ANY_DATA)    # any request of ~bus/request
SYNC_FUNCTION = Function('sync', cmd1=SYNC, reply=ANY_DATA, repeatable=True)
ECHO_FUNCTION = Function('echo', cmd1=ECHO, layout=ANY_DATA, reply=ANY_DATA, repeatable=True)
LIFT_FUNCTION = _move('lift', LIFT, ('up', 'down'), Value('distance', 'mm'))
GIMBAL_FUNCTION = _move('gimbal', GIMBAL, ('left', 'right', 'up', 'down'),
                        Value('angle', 'degrees'))
ENVIRONMENT_FUNCTION = Function('environment', ENVIRONMENT, reply=Environment.LAYOUT,
                                repeatable=True)
# Asks for one chunk of the board's announcement.
ANNOUNCEMENT = Function(
    'announcement', announcement.TYPE, layout=Layout('<B', [Value('index')]),
    reply=announcement.Chunk.LAYOUT, repeatable=True, key='bus/announcements')

BUILT_IN = {(function.cmd1, function.cmd2): function for function in (
    SYNC_FUNCTION, ECHO_FUNCTION, LIFT_FUNCTION, GIMBAL_FUNCTION, ENVIRONMENT_FUNCTION,
    ANNOUNCEMENT)}


def built_in(request: Request, otherwise: Function) -> Function:
    """The built-in function that a request calls; else the other one."""
    return BUILT_IN.get((request.cmd1, request.cmd2), otherwise)


SYNC_REQUEST = SYNC_FUNCTION.make_request(())
ENVIRONMENT_REQUEST = ENVIRONMENT_FUNCTION.make_request(())


def lift(direction: int, distance: int) -> Request:
    """A move of the lift: 0 up, 1 down; 0 … 255 mm. ValueError for any other value."""
    return LIFT_FUNCTION.make_request((direction, distance))


def gimbal(direction: int, angle: int) -> Request:
    """A turn of the gimbal: 0 left, 1 right, 2 up, 3 down; 0 … 255 degrees. ValueError likewise."""
    return GIMBAL_FUNCTION.make_request((direction, angle))


def echo(data: bytes) -> Request:
    """A request that the board answers with the same `data`."""
    return Request(ECHO, 0, data)
