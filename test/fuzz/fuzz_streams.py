"""Byte streams for the fuzz tests."""
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus

# Bytes with a meaning in one of the protocols, and their neighbours.
SPECIAL = sorted({bus.STANDARD_FLAG, bus.LONG_FLAG, mcu.STX, mcu.ETX, 0, 1, 2, 3, 4, 7, 8, 9, 10,
                  11, 12, 14, 16, 23, 24, 0x55, 0x20, 0x21, 0x22, 0xFD, 0xFE, 0xFF})

special = st.lists(st.sampled_from(SPECIAL), min_size=1, max_size=40).map(bytes)
valid = st.one_of(
    st.builds(lambda cmd1, data: bus.encode_reply(bus.Reply(cmd1, data)),
              st.sampled_from((0, 1, 2, 3, 0xFF)), st.binary(max_size=300)),
    st.builds(lambda cmd1, cmd2, data: bus.encode_request(bus.Request(cmd1, cmd2, data)),
              st.sampled_from((0, 1, 0x55)), st.sampled_from((0, 0x20, 0x21, 0x22)),
              st.binary(max_size=10)),
    st.builds(mcu.encode_raw, st.sampled_from((0x01, 0x10, 0x77)), st.integers(0, 255),
              st.binary(max_size=20)),
    st.builds(lambda type_, data: arduino.encode_raw(type_, data), st.integers(0, 13),
              st.binary(max_size=30)))


@st.composite
def damaged(draw):
    """A valid frame with a byte changed, removed, or inserted."""
    frame = bytearray(draw(valid))
    at = draw(st.integers(0, len(frame) - 1))
    kind = draw(st.sampled_from(('change', 'remove', 'insert')))
    if kind == 'change':
        frame[at] ^= draw(st.integers(1, 255))
    elif kind == 'remove':
        del frame[at]
    else:
        frame.insert(at, draw(st.integers(0, 255)))
    return bytes(frame)


garbage = st.lists(st.one_of(st.binary(max_size=60), special, valid, damaged(),
                             st.builds(lambda unit, n: unit * n, special, st.integers(1, 40))),
                   max_size=20).map(b''.join)
