"""Runs simulated boards for tests with simulated time."""
from serial_communication.simulation.line import SimulatedLine


class Bench:
    """A board on a line with simulated time, which `run` advances."""

    def __init__(self, board, decoder, **line_arguments):
        self.board = board
        self.decoder = decoder
        self.now = 1000.0
        self.wire = []          # (time, bytes)
        self.said = []
        self._notes = []        # (event, fields)
        self.line = SimulatedLine(board, lambda data: self.wire.append((self.now, data)),
                                  note=lambda _now, *note: self._notes.append(note),
                                  say=self.said.append, **line_arguments)
        self.line.start(self.now)
        self._taken = 0

    def notes(self, event):
        """The fields of these events."""
        return [fields for each, fields in self._notes if each == event]

    def run(self, seconds, until=None):
        """Advance the time by `seconds`, or until `until` is true; False if it never was.

        The board is called whenever it asked for it.
        """
        end = self.now + seconds
        while True:
            due = self.line.tick(self.now)
            if until and until():
                return True
            assert due is None or due > self.now, 'the board asked to be called in the past'
            if due is None or due > end:
                self.now = end
                return not until
            self.now = due

    def feed(self, data):
        self.line.receive(data, self.now)
        self.line.tick(self.now)

    def output(self):
        """The bytes written since the last call."""
        data = b''.join(data for _, data in self.wire[self._taken:])
        self._taken = len(self.wire)
        return data

    def messages(self, kind=None):
        """The messages decoded from the bytes written since the last call."""
        frames = self.decoder.feed(self.output())
        return [frame.message for frame in frames if frame.message is not None
                and (kind is None or isinstance(frame.message, kind))]
