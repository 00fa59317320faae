"""Frames in both directions: a colon, then TYPE, number, DATA and their XOR in hex, a newline."""
from serial_communication.framing.layout import Value, message_class
from serial_communication.framing.stream import (CHECKSUM, FRAMING, UNKNOWN, StreamDecoder,
                                                 by_type, invalid_frame, running_xor)

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

    CAUSES = CHECKSUM, FRAMING, UNKNOWN
    MESSAGES = by_type(Load, Hold)
    STARTS = b':'

    def frame_at(self, at: int):
        end = self.buffer.find(b'\n', at, at + 40)
        if end < 0:
            size = len(self.buffer) - at
            return size + 1 if size < 40 else None
        try:
            body = bytes.fromhex(self.buffer[at + 1:end].decode())
        except ValueError:
            return None
        if len(body) < 3:
            return None
        raw = self.buffer[at:end + 1]
        if running_xor(body, 0)[-1]:
            return invalid_frame(raw, CHECKSUM, 'the checksum does not match')
        return self.whole(raw, body[0], body[1], body[2:-1])
