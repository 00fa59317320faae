"""Runs simulated boards for tests with simulated time."""
from serial_communication.transport.port import PortBusy, PortError
from serial_communication.simulation.line import SimulatedLine


class Notes(list):
    """A journal in memory: (time, event, fields)."""

    def write(self, now, event, fields):
        self.append((now, event, dict(fields)))

    def flush_due(self, now):
        return None

    def of(self, *events):
        return [fields for _, event, fields in self if event in events]


class Bench:
    """A board on a line with simulated time, which `run` advances."""

    def __init__(self, board, decoder, **line_arguments):
        self.board = board
        self.decoder = decoder
        self.now = 1000.0
        self.wire = []          # (time, bytes)
        self.said = []
        self.notes = Notes()
        self.busy = self.closed = False
        self.line = SimulatedLine(board, self._write, journal=self.notes, say=self.said.append,
                                  **line_arguments)
        self.line.opened(self.now)
        self.line.start(self.now)
        self._taken = 0

    def _write(self, data):
        if self.closed:
            raise PortError('the port is closed')
        if self.busy:
            raise PortBusy('the port takes no data')
        self.wire.append((self.now, data))

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
