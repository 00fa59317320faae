"""Properties of every decoder for any bytes on the line."""

import by_definition as codec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus_moves import lift
from protocol_cases import (ALL, BOARD_BUS, BUS, BUS_CMD2, CHECKSUMMED, MCU, chunkings, decode,
                            errors_of, feed, give_up, held, name_of, random_chunks, valid)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import (FRAMING, IMPLAUSIBLE, LENGTH, MAX_REPORTED,
                                                 UNKNOWN, running_xor)

every_decoder = pytest.mark.parametrize('kind', ALL, ids=name_of)
every_checksummed = pytest.mark.parametrize('kind', CHECKSUMMED, ids=name_of)
seeds = st.integers(0, 1 << 30)


def damaged(part, by):
    """The bytes with an end cut off, a bit flipped, or as they are."""
    if by % 4 == 1:
        return part[:len(part) - by % 3]
    at = by % len(part)
    return part[:at] + bytes((part[at] ^ 1 << by % 8,)) + part[at + 1:] if by % 4 == 2 else part


# Frames, damaged frames, and frames inside damaged ones. Bytes with a meaning in one of the
# protocols are more frequent than others.
byte, short = st.integers(0, 255), st.binary(max_size=6)
frames = st.one_of(
    st.builds(lambda kind, data: codec.bus_frame(bytes((kind,)), data),
              st.sampled_from((0, 1, 2, 3, 255)),
              st.one_of(short, st.binary(min_size=254, max_size=258))),
    st.builds(lambda cmd2, data: codec.bus_frame(bytes((0x55, cmd2)), data), byte, short),
    st.builds(codec.mcu_frame, byte, byte, short),
    st.builds(lambda data: codec.mcu_frame(0x10, 5, data), st.binary(min_size=10, max_size=10)),
    st.builds(codec.arduino_packet, byte,
              st.one_of(short, st.binary(min_size=250, max_size=257))))
around = st.builds(
    lambda parts, make: make(b''.join(parts)[:250]), st.lists(frames, min_size=1, max_size=3),
    st.sampled_from((lambda data: codec.bus_frame(b'\2', data),
                     lambda data: codec.bus_frame(b'\x55\x30', data),
                     lambda data: codec.mcu_frame(0x63, 0, data))))
spiteful = st.lists(st.one_of(
    st.builds(damaged, st.one_of(frames, around), st.integers(0, 300)), st.binary(max_size=30),
    st.lists(st.sampled_from((0, 1, 2, 3, 4, 9, 12, 14, 0x10, 0x55, 0x22, 0xA5, 0x5A, 0xD0, 254,
                              255)), max_size=40).map(bytes),
    st.sampled_from((b'\xa5\xfe', b'\x5a\0\4', b'\x5a\xff\0', b'\2\xff', b'\2\x0c\x10',
                     b'\xa5\2\x55\x22', b'\xa5\2\x55\x22\xd0', b'\3' * 9, b'\1' * 200))),
    max_size=12).map(b''.join)
FRAME_AT = {BUS: codec.reply_at, BOARD_BUS: codec.request_at, MCU: codec.mcu_at,
            BUS_CMD2: lambda stream, at: codec.bus_at(stream, at, 2)}


@given(st.binary(max_size=400), st.integers(0, 255))
def test_running_xor(data, before):
    value, expected = before, bytearray()
    for byte in data:
        value ^= byte
        expected.append(value)
    # The initial value precedes the first byte.
    assert running_xor(data, before) == bytes(expected)


# -- arbitrary bytes ------------------------------------------------------------------------------

@every_decoder
@given(stream=spiteful, seed=seeds)
def test_any_bytes_give_the_frames_of_the_definition_with_the_stamps_of_their_last_bytes(
        kind, stream, seed):
    """Without exceptions; frames and counts do not depend on the chunks: see `decode`."""
    decode(kind, stream, end=False)
    decode(kind, stream)
    decoder, ends, found = kind.make(), [0], []
    for number, chunk in enumerate(random_chunks(stream, seed)):
        ends.append(ends[-1] + len(chunk))
        found += decoder.feed(chunk, number)
    found += give_up(decoder)
    # That a type is not known, or its length or values are wrong, is not asked here.
    found = [frame for frame in found if frame.cause in ('', LENGTH, UNKNOWN, IMPLAUSIBLE)]
    expected, _ = codec.decode(stream, FRAME_AT.get(kind, codec.arduino_at), True)
    assert [(frame.type, frame.data) for frame in found] == [
        (frame.type, frame.data) for frame in expected]
    for frame, right in zip(found, expected):
        str(frame.message)
        assert not kind.checksummed or frame.raw == stream[right.start:right.end]
        assert ends[frame.stamp] < right.end <= ends[frame.stamp + 1]


@every_checksummed
def test_noise_is_one_error_returned_when_a_frame_or_a_silence_ends_it(kind):
    wire, noise = sample_wires(kind)[0], kind.quiet * 9
    for chunks in chunkings(noise):
        decoder = kind.make()
        assert feed(decoder, chunks * 2) == [] and decoder.pending and not decoder.begun
        assert [frame.raw for frame in decoder.feed(wire)] == [noise * 2, wire]
        assert feed(decoder, chunks) == []
        assert [(frame.raw, frame.cause) for frame in decoder.give_up()] == [(noise, FRAMING)]
        assert not decoder.pending


@every_checksummed
def test_endless_noise_is_one_error_for_every_1100_bytes(kind):
    """Otherwise a line at a wrong baud rate would show no error, and memory would grow."""
    noise = bytes(value for value in range(6, 90)) * 40
    for chunks in chunkings(noise):
        decoder = kind.make()
        frames = feed(decoder, chunks)
        assert [frame.raw for frame in frames] == [noise[at:at + MAX_REPORTED]
                                                   for at in (0, 1100, 2200)]
        assert [frame.raw for frame in decoder.give_up()] == [noise[3300:]]


@every_checksummed
def test_noise_has_the_stamp_of_its_last_byte(kind):
    wire, decoder = sample_wires(kind)[0], kind.make()
    for number, data in enumerate((kind.quiet, kind.quiet, wire[:1], wire[1:])):
        frames = decoder.feed(data, number)
    assert [frame.stamp for frame in frames] == [1, 3]
    decoder.feed(kind.false_start, 4)
    decoder.feed(wire, 5)
    assert [frame.stamp for frame in decoder.give_up()] == [4, 5]


@every_decoder
@given(stream=spiteful, seed=seeds)
def test_a_decoder_holds_at_most_one_frame_and_some_noise(kind, stream, seed):
    decoder = kind.make()
    for chunk in random_chunks(stream * 8, seed):
        decoder.feed(chunk)
        assert held(decoder) <= max(kind.longest, MAX_REPORTED)
        assert decoder.pending or not held_bytes(decoder)


def held_bytes(decoder):
    return [value for value in vars(decoder).values()
            if isinstance(value, bytes) and len(value) > 1]     # one byte: the XOR so far


@every_decoder
@pytest.mark.parametrize('end', [give_up, lambda decoder: decoder.reset()],
                         ids=('give_up', 'reset'))
@given(stream=spiteful)
def test_nothing_is_pending_after_giving_up_or_a_reset_and_the_next_frames_are_found(
        kind, end, stream):
    decoder = kind.make()
    decoder.feed(stream)
    end(decoder)
    assert not decoder.pending and decoder.give_up() == []
    for wire in sample_wires(kind):
        assert [(frame.raw, frame.cause) for frame in decoder.feed(wire)] == [(wire, '')]


# -- an invalid frame never hides a valid one ---------------------------------------------------

def sample_wires(kind):
    """Two valid frames of each kind of decoder."""
    if kind is MCU:
        return [mcu.encode(mcu.SensorStatus(47, 58, 0.0, -2.43, 2.43), 156),
                mcu.encode(mcu.AdcStatus(0, 0, 15, 0, 543, 144), 2)]
    if kind is BOARD_BUS:
        return [bus.encode_request(lift(0, 100)), bus.encode_request(bus.ENVIRONMENT_REQUEST)]
    if kind in CHECKSUMMED:
        two = kind is not BUS
        return [bus.encode_reply(bus.Reply(bus.OK, b'\x5e\1\3\x0a\xcc\x12'), two),
                bus.encode_reply(bus.Reply(bus.OK), two)]
    if kind.name.startswith('board'):
        return [arduino.encode(arduino.SpeedCommand(400)), arduino.encode(arduino.Heartbeat())]
    return [arduino.encode(arduino.Ticks(7)), arduino.encode(arduino.Imu(16384, *[0] * 10))]


@every_checksummed
def test_a_false_start_delays_frames_until_it_is_given_up(kind):
    """The frames after it wait; one `give_up` returns all of them, in order."""
    wires = sample_wires(kind)
    for chunks in chunkings(kind.false_start + b''.join(wires)):
        decoder = kind.make()
        frames = feed(decoder, chunks)
        assert valid(frames) == [] and decoder.pending
        frames += decoder.give_up()
        assert [frame.raw for frame in valid(frames)] == wires
        assert not decoder.pending and errors_of(frames) == {FRAMING: 1}
