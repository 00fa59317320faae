"""The cost of a byte does not grow with the bytes before it, in any stream.

The cost is counted, not timed: lines of Python that run, and calls, each of which costs about as
much as ten lines.
"""
import sys
from functools import lru_cache

import pytest
from bus_moves import lift

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu

_CALL = 10          # lines
_SIZE = 8000        # bytes of a stream
_LIMIT = 5          # times the cost of clean traffic

BUS = b''.join(bus.encode_reply(bus.Reply(bus.OK, data))
               for data in [bus.Environment(350, 25.63, 48.12).pack()] * 4 + [b''])
REQUESTS = bus.encode_request(bus.ENVIRONMENT_REQUEST) * 4 + bus.encode_request(lift(0, 100))
MCU = b''.join(mcu.encode(mcu.SensorStatus(400 + seq, 500, 12.34, -2.43, 2.43), seq)
               for seq in range(256))
CAR = b''.join(map(arduino.encode, (
    arduino.Imu(16384, 0, 0, 0, 10, -20, 30, 100, -200, 8192, -1290), arduino.Ticks(7),
    arduino.SteeringAngle(512))))

BUS_STREAMS = (
    b'\xa5', b'\x5a', b'\xa5\x5a',              # flags
    b'\xa5\xfe', b'\x5a\x00\x04',               # with the longest lengths
    b'\xa5\xff', b'\xa5\xff\x00',               # with one that cannot be
    b'\xa5\x00\x02\x00',                        # no data, and a false checksum
    b'\xa5\x00', b'\x5a\x00', bytes(range(90)),     # a flag and noise; noise alone
    bus.encode_reply(bus.Reply(0)),                 # the shortest valid frame
    b''.join(bytes((0xA5, size)) for size in range(255)))
MCU_STREAMS = (
    b'\x02', b'\x03', b'\x02\x03',              # STX, ETX
    b'\x02\x00', b'\x02\xff', b'\x02\xff\x03',  # with a LEN that cannot be, or the longest
    b'\x02\x03\x01',                            # a TYPE with a LEN that is not its own
    b'\x02\x0c\x10' + b'\x03' * 13, b'\x02\x02\x09\x09\x01\x03',    # with a false CRC
    mcu.encode_raw(9, 9, b''), bytes(range(4, 200)))
CAR_STREAMS = (
    b'\0', b'\1\0',                             # no packet; one without a type
    b'\2\0', b'\xff' * 258 + b'\0',             # codes that run past the end
    b'\2\x63\0', b'\2\7\0', b'\2\3\0',          # an unknown type; a wrong length; the shortest text
    b'\1', b'\1' * 257 + b'\0', b'\1' * 259 + b'\0',    # no end; the largest; one byte more
    arduino.encode_raw(1, b'\7' * 254), arduino.encode(arduino.SteeringAngle(1025)))
CASES = [(make, clean, worst) for make, clean, streams in (
    (bus.ReplyDecoder, BUS, BUS_STREAMS), (bus.RequestDecoder, REQUESTS, BUS_STREAMS),
    (mcu.Decoder, MCU, MCU_STREAMS), (arduino.Decoder, CAR, CAR_STREAMS)) for worst in streams]


@lru_cache(maxsize=200)         # clean traffic is the same for many cases
def work(make, unit, size, chunk):
    """Lines a byte that decoding takes; a call counts as ten lines."""
    counts = {'line': 0, 'call': 0, 'c_call': 0}

    def count(_frame, event, _argument):
        if event in counts:
            counts[event] += 1
        return count

    stream = (unit * (size // len(unit) + 1))[:size]
    chunks = [stream[at:at + chunk] for at in range(0, size, chunk)]
    for install, before in (sys.settrace, sys.gettrace()), (sys.setprofile, sys.getprofile()):
        counts.update(call=0, c_call=0)
        decoder = make()
        install(count)
        try:
            for piece in chunks:
                decoder.feed(piece)
        finally:
            install(before)
    return (counts['line'] + _CALL * (counts['call'] + counts['c_call'])) / size


@pytest.mark.parametrize('chunk', [1, 4096], ids=('byte by byte', 'in reads of 4096'))
@pytest.mark.parametrize('make, clean, worst', CASES, ids=[
    f'{make.__name__} {worst[:8].hex()}' for make, _, worst in CASES])
def test_the_worst_streams_cost_at_most_five_times_clean_traffic(make, clean, worst, chunk):
    size = _SIZE if chunk > 1 else _SIZE // 4
    assert work(make, worst, size, chunk) <= _LIMIT * work(make, clean, size, chunk)
