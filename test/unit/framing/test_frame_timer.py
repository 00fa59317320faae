"""When incomplete frames are given up, with the decoders of all links."""
import pytest

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.stream import FrameTimer

TIMEOUT = 0.05
BAUD = 9600
BYTE = 10 / BAUD     # s
SILENT = 0x11        # no frame begins with this byte
TICKS = arduino.encode(arduino.Ticks(7))
STATUS = mcu.encode(mcu.SensorStatus(400, 500, 1.0, 2.0, 3.0), 7)
REPLY = bus.encode_reply(bus.Reply(bus.OK, bytes(20)))
REQUEST = bus.encode_request(bus.Request(bus.ECHO, 0, bytes(20)))

# A decoder, a frame whose end never comes, how many bytes that frame seems to have, a valid frame.
LINKS = pytest.mark.parametrize('make, false_start, size, wire', [
    (bus.ReplyDecoder, b'\xa5\xf0', 0xF0 + 4, REPLY),
    (bus.RequestDecoder, b'\xa5\xf0', 0xF0 + 5, REQUEST),
    (mcu.Decoder, b'\x02\xf0\x63', 0xF0 + 4, STATUS),
    (arduino.Decoder, b'\xf0', 258, TICKS)], ids=['bus', 'board side', 'mcu', 'arduino'])


class Line:
    """A decoder and its timer, with a clock that the test sets."""

    def __init__(self, make):
        self.now = 10.0
        self.decoder = make()
        self.timer = FrameTimer(self.decoder, TIMEOUT, BAUD)
        self.last_byte = 0.0
        self.got = []      # the time of each valid frame and its bytes

    def receive(self, data):
        """A read at this time."""
        self.last_byte = self.now
        self._take(self.decoder.feed(data))
        self._take(self.timer.overdue(self.last_byte, self.now))

    def wait(self, seconds):
        """Give up what is overdue meanwhile, when it is."""
        end = self.now + seconds
        while True:
            due = self.timer.due(self.last_byte)
            if due is None or due > end:
                break
            self.now = max(self.now, due)
            self._take(self.timer.overdue(self.last_byte, self.now))
        self.now = end

    def _take(self, frames):
        self.got += [(self.now, frame.raw) for frame in frames if not frame.cause]


@LINKS
def test_a_frame_is_given_up_after_its_time_on_the_wire_whatever_is_received(
        make, false_start, size, wire):
    line = Line(make)
    line.receive(false_start)
    while line.decoder.front == 0 and line.decoder.begun:
        line.wait(0.03)
        line.receive(bytes((SILENT,)))
        assert line.now < 12.0, 'it is never given up'
    # Found between two bytes: the one before it was received in time.
    assert TIMEOUT + size * BYTE <= line.now - 10.0 <= TIMEOUT + size * BYTE + 0.031


@LINKS
def test_an_incomplete_frame_is_given_up_after_a_silence(make, false_start, size, wire):
    line = Line(make)
    line.receive(false_start)
    line.wait(TIMEOUT - 0.001)
    assert line.decoder.pending
    line.wait(0.002)
    assert not line.decoder.pending and line.timer.due(line.last_byte) is None


@LINKS
def test_false_starts_that_came_together_are_given_up_together(make, false_start, size, wire):
    """Each is over its own time after its own first byte, not after the one before it."""
    line = Line(make)
    line.receive(false_start * 60)
    together = line.decoder.received
    while line.decoder.front < together and line.decoder.begun:
        line.wait(0.03)
        line.receive(bytes((SILENT,)))
        assert line.now - 10.0 < TIMEOUT + size * BYTE + 0.031


@LINKS
def test_a_frame_in_pieces_is_received_within_its_time(make, false_start, size, wire):
    line = Line(make)
    pause = (TIMEOUT + len(wire) * BYTE) / len(wire) * 0.99
    for at in range(len(wire)):
        line.receive(wire[at:at + 1])
        line.wait(pause if at + 1 < len(wire) else 0.0)
    assert [raw for _, raw in line.got] == [wire]
