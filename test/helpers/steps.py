"""A link without threads and without a device: its port is in memory, its time is that of the test.

For what a link says and refuses. What it does when, and under faults, the judge decides (test/sim).
"""
from links import BusLink
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.call import MasterOptions
from serial_communication.transport.port import Port


class MemoryPort(Port):
    """A port whose other end the test has: `give` what the link reads, and see what it `wrote`.

    `kind` is tty, pty or network.
    """

    def __init__(self, kind='tty'):
        super().__init__('socket://none:1' if kind == 'network' else '/dev/none')
        self.kind = kind
        self.time = 100.0
        self.altered = False    # another program has changed the settings of the tty
        self.is_there, self.is_full, self.is_woken = True, False, False
        self.wrote = []         # the frames
        self.pulses = []        # the lines by which the board was reset
        self._input = b''

    def give(self, data):
        """The board sends these bytes."""
        self._input += data
        self.is_woken = True

    def _open(self):
        if not self.is_there:
            raise FileNotFoundError(2, 'No such file or directory')
        self._input = b''
        return _Opened(self)

    def pause(self, seconds):
        pass

    def is_used(self):
        return False

    def wake(self):
        self.is_woken = True


class _Opened:
    """The open port, as `Port` has it."""

    escaped = bytes

    def __init__(self, port):
        self._port = port
        self.is_pty, self.has_baud = port.kind == 'pty', port.kind == 'tty'
        self.pulse = port.pulses.append

    def read(self, timeout, wants_room):
        if not self._port.is_there:
            raise OSError(5, 'Input/output error')
        data, self._port._input = self._port._input, b''
        return data

    def send(self, data):
        if self._port.is_full:
            raise BlockingIOError
        self._port.wrote.append(data)
        return len(data)

    def unsent(self):
        return 0

    on_its_way = unsent

    def changed_settings(self):
        return self._port.altered

    def renew(self, keeps_input):
        self._port.altered = False
        dropped = 0 if keeps_input else len(self._port._input)
        self._port._input = self._port._input[dropped:]
        return dropped

    def close(self):
        pass


class Steps:
    """Calls the steps of a link when they are due: the first ones open the port."""

    def __init__(self, kind, *arguments, port=None, **options):
        self.port = port or MemoryPort()
        self.link = kind(self.port, *arguments, now=lambda: self.port.time, **options)
        self._due = dict.fromkeys(self.link.loops().values(), 0.0)

    def run(self, seconds):
        """Let so much time pass."""
        port, end = self.port, self.port.time + seconds
        while True:
            step = min(self._due, key=self._due.get)
            due = max(self._due[step], port.time)
            if port.is_woken:
                step, due, port.is_woken = self.link.step, port.time, False
            if due > end:
                port.time = end
                return self
            port.time = due
            self._due[step] = step()

    def give(self, data, seconds=0.01):
        """The board sends these bytes; let so much time pass."""
        self.port.give(data)
        return self.run(seconds)

    def unplug(self):
        """The port vanishes."""
        self.port.is_there = False
        self.port.is_woken = True
        return self.run(0.05)

    def plug(self):
        """The port returns, and the link opens it."""
        self.port.is_there = True
        return self.run(2.0)


class Bus(Steps):
    """A bus link and a board that answers at once: `rule` may return another answer, or bytes."""

    def __init__(self, master=MasterOptions(), **options):
        super().__init__(BusLink, master, **options)
        self.requests = []
        self.rule = lambda request: None
        self._decoder = bus.RequestDecoder()
        self.port.wrote = self      # the board gets what is written

    def append(self, frame):
        """The board gets a frame."""
        for each in self._decoder.feed(frame):
            request = each.message
            self.requests.append(request)
            answer = self.rule(request)
            if answer is None:
                answer = self._usual(request)
            self.port.give(bus.encode_reply(answer) if isinstance(answer, bus.Reply) else answer)

    @staticmethod
    def _usual(request):
        if request.cmd1 in (bus.SYNC, bus.ECHO):
            return bus.Reply(request.cmd1, request.data)
        return bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack()
                         if request == bus.ENVIRONMENT_REQUEST else b'')

    def call(self, request, function=bus.RAW, seconds=10.0):
        """The outcome of a request."""
        call = self.link.submit(request, function)
        self.run(seconds)
        return call.outcome

    @property
    def moves(self):
        """Lift, gimbal and raw requests, in their order."""
        return [each for each in self.requests if each.cmd1 == bus.FUNCTION
                and each != bus.ENVIRONMENT_REQUEST]
