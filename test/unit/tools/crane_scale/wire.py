"""Frames in both directions: a colon, then TYPE, number, DATA and their XOR in hex, a newline."""
from typing import Iterable

from serial_communication.framing.layout import Value, message_class
from serial_communication.framing.stream import (CHECKSUM, FRAMING, UNKNOWN, Bad, Good, Need,
                                                 StreamDecoder, running_xor)

Load = message_class('Load', 0x10, '<H', [Value('value', 'kg', 0.1)], 'load')
Hold = message_class('Hold', 2, '<', (), 'hold')


def encode(message, number: int) -> bytes:
    """Return the frame of a message; `number` is 0 … 255."""
    return encode_raw(bytes((message.TYPE, number)) + message.pack())


def encode_raw(body: bytes) -> bytes:
    """Return the frame of TYPE, number and DATA."""
    return b':%b\n' % (body + running_xor(body, 0)[-1:]).hex().encode()


class Decoder(StreamDecoder):
    """Decodes either direction."""

    STARTS = b':'

    def __init__(self, messages: Iterable = ()) -> None:
        super().__init__(UNKNOWN)
        self.messages = {kind.TYPE: kind for kind in (Load, Hold, *messages)}

    def frame_at(self, at: int):
        end = self.buffer.find(b'\n', at, at + 40)
        if end < 0:
            size = len(self.buffer) - at
            return Need(size + 1) if size < 40 else Bad(1, FRAMING, 'no end')
        try:
            body = bytes.fromhex(self.buffer[at + 1:end].decode())
        except ValueError:
            return Bad(1, FRAMING, 'no digits')
        if len(body) < 3:
            return Bad(1, FRAMING, 'too short')
        size = end + 1 - at
        if running_xor(body, 0)[-1]:
            return Bad(size, CHECKSUM, 'the checksum does not match')
        kind, data = self.messages.get(body[0]), body[2:-1]
        message = kind.unpack(data) if kind and kind.LAYOUT.fits(len(data)) else None
        return Good(size, body[0], body[1], data, message)
