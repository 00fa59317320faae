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
messages.py has the messages; they can be imported from here, too.
"""
from typing import Iterable, List, Optional, Union

from ...framing.parts import Part, Parts
from ...framing.stream import CHECKSUM, NO_FRAME, Bad, Good, Need, StreamDecoder, running_xor
from .messages import (  # noqa: F401
    ANNOUNCEMENT, ANY_DATA, BUILT_IN, CHECKSUM_MISMATCH, ECHO, ECHO_FUNCTION, ENVIRONMENT,
    ENVIRONMENT_FUNCTION, ENVIRONMENT_REQUEST, ERROR, ERROR_TEXTS, FUNCTION, GIMBAL,
    GIMBAL_FUNCTION, INVALID, LIFT, LIFT_FUNCTION, MALFORMED, NOT_SYNCHRONISED, NO_DATA, OK,
    OPERATION_FAILED, RAW, REPLY_NAMES, REQUEST_NAMES, SYNC, SYNC_FUNCTION, SYNC_REQUEST, TOO_LONG,
    UNSUPPORTED, Environment, Function, Reply, Request, built_in, describe_error, echo, gimbal,
    lift)

STANDARD_FLAG = 0xA5
LONG_FLAG = 0x5A
MAX_LENGTH = 1024      # most DATE bytes accepted


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
    _commands = 1  # CMD bytes
    _NAMES = REPLY_NAMES      # the names of CMD1

    def __init__(self, max_length: int = MAX_LENGTH, functions: Iterable[Function] = ()) -> None:
        super().__init__()
        self._max_length = max_length
        self._functions = {**BUILT_IN,
                           **{(each.cmd1, each.cmd2): each for each in functions}}

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
            cmd2 = parts.take_kind('CMD2', {each.cmd2: each.name for each in
                                            self._functions.values() if each.cmd1 == FUNCTION})
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
                 functions: Iterable[Function] = ()) -> None:
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
        function = self._functions.get(request[:2]) if request else None
        if cmd1 == OK and function and function.key:
            return function.reply.parts(data)
        if cmd1 == OK and (request == ENVIRONMENT_REQUEST if request
                           else len(data) == Environment.LAYOUT.size):
            return [part if request else part._replace(meaning='if it is an environment reply')
                    for part in Environment.parts(data)]
        return super()._explain_data(cmd1, cmd2, data, request)


class RequestDecoder(_Decoder):
    """Decodes requests, Master -> Slave. Datelen of an environment request may be 2 or 0."""

    _commands = 2
    _NAMES = REQUEST_NAMES
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
        if cmd1 == FUNCTION and (cmd1, cmd2) in self._functions:
            return self._functions[cmd1, cmd2].request_parts(data)
        return super()._explain_data(cmd1, cmd2, data, request)

    def _short_end(self, frame: bytes) -> int:
        return len(self._ENVIRONMENT) if frame[:5] == self._ENVIRONMENT else 0
