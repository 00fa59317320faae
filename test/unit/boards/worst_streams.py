"""The most expensive streams that anyone can make, beside clean traffic of the same size.

For the test of linear cost. Depends on the protocol code alone.
"""
from typing import Any, Callable, List, NamedTuple

from bus_moves import lift
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus


class WorstStream(NamedTuple):
    """One hostile stream, and what it is to be compared with."""

    link: str                           # bus, board side of bus, arduino or mcu
    name: str
    decoder: Callable[[], Any]
    clean: bytes                        # ordinary traffic, undamaged
    worst: bytes


def worst_streams(size: int = 1 << 20) -> List[WorstStream]:
    """Streams of `size` bytes each for every decoder."""
    kinds = (
        ('bus', bus.ReplyDecoder, _clean_replies(), _bus_false_starts()),
        ('board side of bus', bus.RequestDecoder, _clean_requests(), _bus_false_starts()),
        ('mcu', mcu.Decoder, _clean_mcu(), _mcu_false_starts()),
        ('arduino', arduino.Decoder, _clean_arduino(), _bad_packets()),
    )
    return [WorstStream(link, name, decoder, _repeat(clean, size), _repeat(unit, size))
            for link, decoder, clean, units in kinds for name, unit in units]


def _repeat(unit: bytes, size: int) -> bytes:
    return (unit * (size // len(unit) + 1))[:size]


def _clean_replies() -> bytes:
    """A polled environment, a motion now and then."""
    environment = bus.encode_reply(bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack()))
    return environment * 4 + bus.encode_reply(bus.Reply(bus.OK))


def _clean_requests() -> bytes:
    return bus.encode_request(bus.ENVIRONMENT_REQUEST) * 4 + bus.encode_request(lift(0, 100))


def _clean_mcu() -> bytes:
    return b''.join(mcu.encode(mcu.SensorStatus(400 + seq, 500, 12.34, -2.43, 2.43), seq)
                    for seq in range(256))


def _clean_arduino() -> bytes:
    """A second of what the car sends."""
    imu = arduino.Imu(16384, 0, 0, 0, 10, -20, 30, 100, -200, 8192, -1290)
    packets = [arduino.encode(imu), arduino.encode(arduino.Ticks(7)),
               arduino.encode(arduino.SteeringAngle(512))] * 100
    return b''.join(packets) + arduino.encode(arduino.Voltage(14.8))


def _bus_false_starts():
    near = bus.MAX_LENGTH.to_bytes(2, 'little')
    both = bytes((bus.STANDARD_FLAG, bus.LONG_FLAG))
    return (
        ('a standard flag everywhere', bytes((bus.STANDARD_FLAG,))),
        ('a long flag everywhere', bytes((bus.LONG_FLAG,))),
        ('both flags in turn', both),
        ('flags with the longest standard length', bytes((bus.STANDARD_FLAG, 254))),
        ('flags with the longest length', bytes((bus.LONG_FLAG,)) + near),
        ('flags with a length that cannot be', bytes((bus.STANDARD_FLAG, 255))),
        ('frames without data and a false checksum', bytes((bus.STANDARD_FLAG, 0, 2, 0))),
        ('a flag, a false length, a byte of noise', bytes((bus.STANDARD_FLAG, 255, 0))),
        ('one kind of flag and noise in turn', bytes((bus.STANDARD_FLAG, 0))),
        ('the other kind of flag and noise in turn', bytes((bus.LONG_FLAG, 0))),
        ('noise without a flag', bytes(range(90))),
        ('the shortest valid frames', bus.encode_reply(bus.Reply(0))),
        ('lengths one apart', b''.join(bytes((bus.STANDARD_FLAG, n)) for n in range(255))),
    )


def _mcu_false_starts():
    return (
        ('STX everywhere', bytes((mcu.STX,))),
        ('ETX everywhere', bytes((mcu.ETX,))),
        ('STX and ETX in turn', bytes((mcu.STX, mcu.ETX))),
        ('STX, a LEN that cannot be', bytes((mcu.STX, 0))),
        ('STX, the longest LEN', bytes((mcu.STX, 255))),
        ('STX, the longest LEN, ETX', bytes((mcu.STX, 255, mcu.ETX))),
        ('STX, a known TYPE with a LEN not its own', bytes((mcu.STX, 3, mcu.AdcStatus.TYPE))),
        ('a known TYPE, a false CRC, ETX everywhere',
         bytes((mcu.STX, 12, mcu.SensorStatus.TYPE)) + bytes((mcu.ETX,)) * 13),
        ('the shortest frames, with a false CRC', bytes((mcu.STX, 2, 9, 9, 1, mcu.ETX))),
        ('the shortest valid frames', mcu.encode_raw(9, 9, b'')),
        ('noise without STX', bytes(range(4, 200))),
    )


def _bad_packets():
    return (
        ('nothing but ends', b'\0'),
        ('packets without a type', b'\1\0'),
        ('codes that run past the end', b'\2\0'),
        ('codes that run past the end, of the largest size', b'\xff' * 258 + b'\0'),
        ('unknown types', b'\2\x63\0'),
        ('a known type with a wrong length', b'\2\7\0'),
        ('no end', b'\1'),
        ('oversize', b'\1' * 259 + b'\0'),
        ('zeros only, the largest packet', b'\1' * 257 + b'\0'),
        ('the shortest log texts', b'\2\3\0'),
        ('log texts of control characters', arduino.encode_raw(1, b'\7' * 254)),
        ('implausible angles', arduino.encode(arduino.SteeringAngle(1025))),
    )
