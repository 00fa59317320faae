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
from typing import Union

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

    def __init__(self, max_length: int = MAX_LENGTH) -> None:
        super().__init__()
        self._max_length = max_length

    def _good(self, size: int, commands: bytes, data: bytes) -> Good:
        raise NotImplementedError

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
    """

    def __init__(self, has_cmd2: bool = False, max_length: int = MAX_LENGTH) -> None:
        super().__init__(max_length)
        self._commands = 2 if has_cmd2 else 1

    def _good(self, size: int, commands: bytes, data: bytes) -> Good:
        reply = Reply(commands[0], data, commands[1] if len(commands) > 1 else 0)
        return Good(size, reply.cmd1, 0, data, reply)


class RequestDecoder(_Decoder):
    """Decodes requests, Master -> Slave. Datelen of an environment request may be 2 or 0."""

    _commands = 2
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
