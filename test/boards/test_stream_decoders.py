"""Properties of every decoder for any bytes on the line."""
import random

import by_definition
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol_cases import (ALL, BOARD_BUS, BUS, CHECKSUMMED, MCU, check_counted,
                            chunkings, decode, feed, give_up, held, name_of, random_chunks,
                            total, valid)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import CHECKSUM, FRAMING, MAX_REPORTED, running_xor

every_decoder = pytest.mark.parametrize('kind', ALL, ids=name_of)
every_checksummed = pytest.mark.parametrize('kind', CHECKSUMMED, ids=name_of)
seeds = st.integers(0, 1 << 30)

# Bytes with a meaning in one of the protocols are more frequent than others.
spiteful = st.one_of(
    st.binary(max_size=300),
    st.lists(st.sampled_from((0, 1, 2, 3, 4, 9, 12, 14, 0x10, 0x55, 0x22, 0xA5, 0x5A, 0xD0, 254,
                              255)), max_size=400).map(bytes),
    st.lists(st.sampled_from((b'\xa5\xfe', b'\x5a\0\4', b'\x5a\xff\0', b'\2\xff', b'\2\2',
                              b'\2\x0c\x10', b'\xa5\2\x55\x22', b'\xff', b'\1', b'\0',
                              b'\3' * 9, b'\xa5\0\2\xa7', b'\1' * 200)),
             max_size=60).map(b''.join))


FRAME_AT = {BUS: by_definition.reply_at, BOARD_BUS: by_definition.request_at,
            MCU: by_definition.mcu_at}


def frame_at(kind, stream, at):
    return FRAME_AT.get(kind, lambda stream, at: by_definition.bus_at(stream, at, 2))(stream, at)


def valid_frame_end(kind, stream, at):
    """The end of the valid frame that begins at `at`, or 0."""
    found = frame_at(kind, stream, at)
    return found.end if isinstance(found, by_definition.Frame) else 0


def frames_by_definition(kind, stream):
    """The bytes of every frame: after a failed check the search continues one byte later."""
    found, _end = by_definition.decode(
        stream, lambda stream, at: frame_at(kind, stream, at), True)
    return [stream[frame.start:frame.end] for frame in found]


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
@given(stream=spiteful)
def test_any_bytes_give_the_frames_of_the_definition_in_any_chunks(kind, stream):
    """Without exceptions; frames and counts do not depend on the chunks: see `decode`."""
    decode(kind, stream, end=False)
    frames, _ = decode(kind, stream)
    if kind.checksummed:      # for packets see test_by_definition
        assert [frame.raw for frame in frames] == frames_by_definition(kind, stream)


@every_decoder
@given(stream=spiteful, seed=seeds)
def test_one_invalid_frame_is_returned_for_each_counted_error(kind, stream, seed):
    """At any time, after any events between two reads."""
    decoder, chance, frames = kind.make(), random.Random(seed), []
    for chunk in random_chunks(stream, seed):
        frames += decoder.feed(chunk)
        frames += chance.choice((list, list, decoder.give_up))()
        check_counted(kind, frames, decoder.errors)


@every_checksummed
def test_noise_is_one_error_returned_when_a_frame_or_a_silence_ends_it(kind):
    wire, noise = sample_wires(kind)[0], kind.quiet * 9
    for chunks in chunkings(noise):
        decoder = kind.make()
        assert feed(decoder, chunks * 2) == [] and decoder.pending and not decoder.begun
        assert [frame.raw for frame in decoder.feed(wire)] == [noise * 2, wire]
        assert feed(decoder, chunks) == [] and decoder.errors[FRAMING] == 1
        assert [(frame.raw, frame.cause) for frame in decoder.give_up()] == [(noise, FRAMING)]
        assert not decoder.pending and decoder.errors[FRAMING] == 2


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
        assert decoder.errors[FRAMING] == 4


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
def test_memory_does_not_grow_with_the_number_of_reads(kind):
    for unit in (kind.quiet, b'\xa5\x05\x5a', b'\2\5', b'\1'):
        decoder = kind.make()
        for value in unit * (100000 // 4 // len(unit)):
            decoder.feed(bytes((value,)))
        assert held(decoder) <= max(kind.longest, MAX_REPORTED)


@every_decoder
@given(stream=spiteful)
def test_giving_up_ends_with_nothing_pending(kind, stream):
    decoder = kind.make()
    decoder.feed(stream)
    before = total(decoder.errors)
    was_pending = decoder.pending
    give_up(decoder)
    assert not decoder.pending and decoder.give_up() == []
    if was_pending and before == 0:
        assert total(decoder.errors) >= 1 or valid(kind.make().feed(stream))
    for wire in sample_wires(kind):
        assert [frame.raw for frame in valid(decoder.feed(wire))] == [wire]


@every_decoder
@given(stream=spiteful)
def test_reset_forgets_only_the_pending_bytes(kind, stream):
    decoder = kind.make()
    decoder.feed(stream)
    errors = dict(decoder.errors)
    decoder.reset()
    assert not decoder.pending and decoder.errors == errors
    for wire in sample_wires(kind):
        assert [frame.raw for frame in valid(decoder.feed(wire))] == [wire]
    assert decoder.errors == errors


# -- an invalid frame never hides a valid one ---------------------------------------------------

def sample_wires(kind):
    """Two valid frames of each kind of decoder."""
    if kind is MCU:
        return [mcu.encode(mcu.SensorStatus(47, 58, 0.0, -2.43, 2.43), 156),
                mcu.encode(mcu.AdcStatus(0, 0, 15, 0, 543, 144), 2)]
    if kind is BOARD_BUS:
        return [bus.encode_request(bus.lift(0, 100)), bus.encode_request(bus.ENVIRONMENT_REQUEST)]
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
        assert valid(feed(decoder, chunks)) == [] and decoder.pending
        assert [frame.raw for frame in valid(decoder.give_up())] == wires
        assert not decoder.pending
        assert decoder.errors[FRAMING] == 1 and total(decoder.errors) == 1


@every_checksummed
def test_false_starts_inside_a_false_start_are_given_up_one_by_one(kind):
    decoder = kind.make()
    decoder.feed(kind.false_start * 3 + sample_wires(kind)[0])
    rounds = []
    while decoder.pending:
        rounds.append([frame.raw for frame in valid(decoder.give_up())])
    assert rounds == [[], [], [sample_wires(kind)[0]]]


@every_checksummed
def test_the_front_moves_only_when_a_frame_is_decided(kind):
    wire = sample_wires(kind)[0]
    decoder = kind.make()
    decoder.feed(wire + wire[:3])
    assert decoder.front == len(wire)
    decoder.feed(wire[3:4])
    assert decoder.front == len(wire) and decoder.needed <= len(wire)
    decoder.feed(wire[4:] + wire[:2])
    assert decoder.front == 2 * len(wire)
    decoder.reset()
    assert decoder.front == decoder.received == 2 * len(wire) + 2


@pytest.mark.parametrize('kind, wire', [
    (BUS, bus.encode_reply(bus.Reply(bus.OK, b'\xa5\x5a\x11' * 20))),
    (BOARD_BUS, bus.encode_request(bus.Request(bus.ECHO, 0, b'\xa5\x5a\x11' * 20))),
    (MCU, mcu.encode_raw(0x63, 0, b'\2\3\2\x10\2' * 12))], ids=('bus', 'board side', 'mcu'))
def test_noise_with_many_false_starts_counts_once(kind, wire):
    damaged = bytearray(wire)
    damaged[-1 if kind is not MCU else -2] ^= 0x80
    frames, errors = decode(kind, bytes(damaged) + sample_wires(kind)[0])
    assert [frame.raw for frame in frames] == [sample_wires(kind)[0]]
    assert errors == dict(kind.make().errors, checksum=1)


# -- stamps ---------------------------------------------------------------------------------------

@every_decoder
def test_a_frame_has_the_stamp_of_its_last_byte(kind):
    first, second = sample_wires(kind)
    decoder = kind.make()
    stream = first + second
    got = []
    for at in range(len(stream)):
        got += decoder.feed(stream[at:at + 1], stamp=at)
    assert [(frame.raw, frame.stamp) for frame in got] == [
        (first, len(first) - 1), (second, len(stream) - 1)]
    got = decoder.feed(stream, stamp='both') + decoder.feed(first[:1], stamp='begun')
    got += decoder.feed(first[1:] + second[:1], stamp='ended') + decoder.feed(second[1:], 'last')
    assert [frame.stamp for frame in got] == ['both', 'both', 'ended', 'last']


@every_checksummed
def test_a_frame_after_a_false_start_has_the_stamp_of_its_last_byte(kind):
    first, second = sample_wires(kind)
    decoder = kind.make()
    decoder.feed(kind.false_start, 'false')
    decoder.feed(first[:2], 'begun')
    decoder.feed(first[2:], 'first')
    decoder.feed(second[:-1], 'begun again')
    decoder.feed(second[-1:], 'second')
    decoder.feed(first[:-1], 'unfinished')
    assert [(frame.raw, frame.stamp) for frame in decoder.give_up() if not frame.cause] == [
        (first, 'first'), (second, 'second')]
    assert [frame.stamp for frame in decoder.feed(first[-1:], 'third')] == ['third']


def false_frame(kind, inside):
    """The begin and the end of a frame around these bytes, with a wrong checksum."""
    if kind is MCU:
        begin, filler, end = bytes((2, len(inside) + 3, 0x63, 0)), b'\x11', b'\3'
        right = by_definition.xor_of(begin[2:] + inside + filler)
    else:
        begin = bytes((0xA5, len(inside) + 1)) + b'\x09' * (1 if kind is BUS else 2)
        filler, end = b'\x11', b''
        right = by_definition.xor_of(begin + inside + filler)
    return begin, filler + bytes((right ^ 0x40,)) + end


@every_checksummed
def test_a_frame_inside_an_invalid_one_has_the_stamp_of_its_last_byte(kind):
    for inside in [[wire] for wire in sample_wires(kind)] + [sample_wires(kind)]:
        begin, end = false_frame(kind, b''.join(inside))
        decoder = kind.make()
        assert decoder.feed(begin, 'begin') == []
        for number, wire in enumerate(inside):
            assert decoder.feed(wire, number) == []
        frames = decoder.feed(end, 'end')
        assert [(frame.raw, frame.stamp) for frame in frames if not frame.cause] == [
            (wire, number) for number, wire in enumerate(inside)]
        assert (frames[0].cause, frames[0].stamp) == (CHECKSUM, 'end')


def check_stamps(kind, stream, seed):
    """In random chunks, each valid frame has the stamp of the read with its last byte."""
    decoder, ends, fed, frames = kind.make(), [], 0, []
    for number, chunk in enumerate(random_chunks(stream, seed)):
        fed += len(chunk)
        ends.append(fed)
        frames += decoder.feed(chunk, number)
    frames += give_up(decoder)
    at = 0
    for frame in frames:
        if frame.cause:
            continue
        # Its place in the stream: the reference decoder finds the same frames.
        while valid_frame_end(kind, stream, at) != at + len(frame.raw) or not stream.startswith(
                frame.raw, at):
            at += 1
        at += len(frame.raw)
        assert ends[frame.stamp] >= at
        assert frame.stamp == 0 or ends[frame.stamp - 1] < at


@every_checksummed
@given(seed=seeds, stream=spiteful)
def test_stamps_in_any_stream(kind, seed, stream):
    wires = sample_wires(kind)
    check_stamps(kind, stream + wires[0] + stream[:40] + wires[1], seed)
