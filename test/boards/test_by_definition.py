"""The protocols by definition, against the package; test_stream_decoders compares the decoders."""
import by_definition as codec
from hypothesis import given
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.announcement import chunks_of


@given(st.binary(min_size=1, max_size=300), st.integers(2, 60))
def test_an_announcement_has_the_chunks_of_the_package(text, size):
    assert codec.announcement(text, size) == [chunk.pack() for chunk in chunks_of(text, size)]


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
