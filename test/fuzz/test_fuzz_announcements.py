"""Any chunks of announcements in any order, damaged in any way, on all links: nothing is raised,
the memory is bounded, only whole texts are returned, and valid rounds give the board's text."""
import hypothesis.strategies as st
import pytest
from fuzz_streams import garbage
from hypothesis import given

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.announcement import (LONGEST, Assembly, Chunk, chunks_of,
                                                       crc_of)

# How a chunk crosses each line.
LINKS = {
    'arduino': (arduino.Decoder, arduino.encode),
    'mcu': (mcu.Decoder, lambda chunk: mcu.encode(chunk, chunk.index)),
    'bus': (bus.ReplyDecoder, lambda chunk: bus.encode_reply(bus.Reply(bus.OK, chunk.pack()))),
}
every_link = pytest.mark.parametrize('name', sorted(LINKS))
texts = st.binary(max_size=300)
sizes = st.integers(2, 249)
FEW = st.integers(0, 3)
BYTES = st.one_of(FEW, st.integers(0, 255))
any_chunk = st.builds(Chunk, BYTES, BYTES, st.one_of(FEW, st.integers(0, 0xFFFF)),
                      st.binary(max_size=251))


class Listener:
    """Takes the bytes of a line, as a link does, and keeps the whole texts."""

    def __init__(self, name):
        make, self.encode = LINKS[name]
        self._decoder = make()
        self.assembly = Assembly()
        self.texts = []
        self.crcs = set()      # of all chunks that were received

    def take(self, chunk):
        self.crcs.add(chunk.crc)
        try:
            text = self.assembly.add(chunk)
        except ValueError as error:
            assert 'over 2048 bytes' in str(error)
            text = None
        if text is not None:
            assert crc_of(text) in self.crcs and len(text) <= LONGEST
            self.texts.append(text)
        begun = self.assembly._begun
        assert len(begun) <= 4
        assert all(sum(map(len, pieces.values())) <= LONGEST for pieces in begun.values())

    def hear(self, data):
        frames = self._decoder.feed(data)
        for frame in frames:
            if frame.cause or frame.message is None:
                continue
            if isinstance(frame.message, bus.Reply):
                if frame.message.cmd1 == bus.OK and Chunk.LAYOUT.fits(len(frame.data)):
                    self.take(Chunk.unpack(frame.data))
            elif isinstance(frame.message, Chunk):
                str(frame.message)
                self.take(frame.message)

    def end_of_noise(self):
        while self._decoder.pending:
            self._decoder.give_up()
        self.hear(b'\0' * (self.encode is arduino.encode))

    def say(self, chunks):
        self.hear(b''.join(map(self.encode, chunks)))


@given(chunks=st.lists(any_chunk, max_size=60), text=texts, size=sizes)
def test_any_chunks_raise_nothing_and_a_valid_round_gives_the_text(chunks, text, size):
    listener = Listener('arduino')
    for chunk in chunks:
        listener.take(chunk)
    before = listener.assembly.text
    for chunk in chunks_of(text, size) * 2:
        listener.take(chunk)
    # A chunk of the same CRC and count may be among those before: they are of the known text.
    assert listener.assembly.text == text or crc_of(before) == crc_of(text)


@every_link
@given(data=st.data(), first=texts, second=texts, size=sizes)
def test_chunks_that_are_lost_repeated_and_of_two_texts_give_each_text_and_no_other(
        name, data, first, second, size):
    listener = Listener(name)
    old, new = chunks_of(first, size), chunks_of(second, size)
    listener.say(data.draw(st.lists(st.sampled_from(old + new), max_size=3 * len(old + new))))
    listener.say(data.draw(st.permutations(new)))
    assert listener.texts[-1] == second and set(listener.texts) <= {first, second}
    assert all(one != other for one, other in zip(listener.texts, listener.texts[1:]))


@every_link
@given(data=st.data(), text=texts, size=sizes)
def test_damage_of_any_kind_is_over_after_two_valid_rounds(name, data, text, size):
    listener = Listener(name)
    chunks = chunks_of(text, size)
    for chunk in data.draw(st.lists(st.sampled_from(chunks), max_size=20)):
        raw = bytearray(listener.encode(chunk))
        kind = data.draw(st.sampled_from(('flip', 'cut', 'lose', 'double', 'insert', 'valid')))
        at = data.draw(st.integers(0, len(raw) - 1))
        if kind == 'flip':
            raw[at] ^= data.draw(st.integers(1, 255))
        elif kind == 'cut':
            del raw[at:]
        elif kind == 'lose':
            del raw[at]
        elif kind == 'double':
            raw *= 2
        elif kind == 'insert':
            raw[at:at] = data.draw(garbage)[:40]
        listener.hear(bytes(raw))
    listener.end_of_noise()
    listener.say(chunks * 2)
    assert listener.assembly.text == text
