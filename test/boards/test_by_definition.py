"""The protocols by definition, against plain bytes, and against the package's decoders."""
import struct

import by_definition as codec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.announcement import chunks_of

VECTORS = [
    # What doc/protocols.md has, byte for byte.
    (codec.request_at, 'a5 02 55 20 00 64 b6', (0x55, 0x20, bytes((0, 100)))),
    (codec.request_at, 'a5 02 55 22 d0', (0x55, 0x22, b'')),
    (codec.request_at, 'a5 00 55 22 d2', (0x55, 0x22, b'')),
    (codec.request_at, 'a5 00 00 00 a5', (0x00, 0x00, b'')),
    (codec.reply_at, 'a5 00 02 a7', (0x02, 0, b'')),
    (codec.reply_at, 'a5 01 ff 40 1b', (0xFF, 0, b'\x40')),
    (codec.reply_at, 'a5 02 03 02 80 26', (0x03, 0, b'\x02\x80')),
    (codec.mcu_at, '02 02 55 07 52 03', (0x55, 7, b'')),
    (codec.mcu_at, '02 0c 10 01 f4 01 58 02 10 27 0a 00 f6 ff 8a 03',
     (0x10, 1, struct.pack('<HHhhh', 500, 600, 10000, 10, -10))),
    (codec.arduino_at, '02 0b 00', (11, 0, b'')),
    (codec.arduino_at, '02 04 01 01 00', (4, 0, b'\0\0')),
    (codec.arduino_at, '04 04 2c 01 00', (4, 0, b'\x2c\x01'))]


@given(st.binary(min_size=1, max_size=300), st.integers(2, 60))
def test_an_announcement_has_the_chunks_of_the_package(text, size):
    assert codec.announcement(text, size) == [chunk.pack() for chunk in chunks_of(text, size)]


@pytest.mark.parametrize('frame_at, raw, content', VECTORS)
def test_plain_vector(frame_at, raw, content):
    raw = bytes.fromhex(raw)
    assert [frame.content for frame in codec.decode(raw, frame_at)[0]] == [content]
    for end in range(len(raw)):     # incomplete
        assert codec.decode(raw[:end], frame_at)[0] == []
    for bit in range(8 * len(raw)):         # one wrong bit is seen where there is a checksum
        bad = bytearray(raw)
        bad[bit // 8] ^= 1 << bit % 8
        found = codec.decode(bytes(bad), frame_at, True)[0]
        if frame_at is not codec.arduino_at:
            assert content not in [frame.content for frame in found]


@given(type_=st.integers(0, 255), seq=st.integers(0, 255), data=st.binary(max_size=253))
def test_encoders_write_what_the_package_writes(type_, seq, data):
    assert codec.arduino_packet(type_, data) == arduino.encode_raw(type_, data)
    assert codec.mcu_frame(type_, seq, data) == mcu.encode_raw(type_, seq, data)
    assert codec.bus_frame(bytes((type_,)), data) == bus.encode_reply(bus.Reply(type_, data))
    assert codec.bus_frame(bytes((type_, seq)), data) == bus.encode_request(
        bus.Request(type_, seq, data)) or (type_, seq, data) == (0x55, 0x22, b'')


def test_reader_gives_up_what_stays_incomplete():
    reader = codec.Reader(codec.reply_at, 0.1)
    good = codec.bus_frame(b'\2', b'')
    assert reader.feed(b'\xa5\x20' + good, 0.0) == []
    assert [frame.type for frame in reader.feed(good, 1.0)] == [2, 2]
