"""Boards for tests, which show all that they do and receive.

They are much simpler than the simulated boards. A board runs in a thread from its construction
until `close`, on a `Pty`, or on the tty with a path, which may vanish and return.
"""
import threading
import time
from functools import partial

import waiting
from fake_bus import FakeBus
from lines import Tty

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu

until = partial(waiting.until, every=0.002)
_GIVE_UP = 0.3      # s after which a board drops an incomplete frame
_QUIET = 0.4        # s after which a car that has talked sends an empty packet


class Board:
    """Decodes the received bytes, and calls `take` with each valid frame."""

    POLL = 0.05     # s between two calls of `idle` at most

    def __init__(self, line, decoder):
        self.line = Tty(line) if isinstance(line, str) else line
        self._recording = threading.Lock()
        self.forget()
        self._decoder = decoder
        self._last_byte = 0.0
        self._closing, self._paused, self._idle = (threading.Event() for _ in range(3))
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)
        self._thread.start()

    @property
    def connected(self):
        """Whether the tty with the path is open."""
        return self.line.connected

    @property
    def raws(self):
        """The bytes of the valid frames."""
        return [frame.raw for frame in list(self.frames)]

    def messages(self, kind=None):
        """The messages received so far."""
        return [frame.message for frame in list(self.frames)
                if kind is None or isinstance(frame.message, kind)]

    def forget(self):
        """Clear the records: all bytes, the valid frames and the invalid ones.

        The frames are stamped with time.monotonic().
        """
        with self._recording:
            self.wire, self.frames, self.bad = bytearray(), [], []

    def take(self, frame):
        """A valid frame was received; for subclasses."""

    def idle(self):
        """Called after each read; for subclasses."""

    def write(self, data):
        """Write bytes; on a tty with a path, False if it is absent."""
        return self.line.write(data)

    def close(self):
        """End the thread, and close the tty."""
        self._closing.set()
        self._thread.join(5)
        if isinstance(self.line, Tty):
            self.line.close()

    def _run(self):
        while not self._closing.is_set():
            try:
                if self._paused.is_set():
                    self._idle.set()
                    raise OSError
                self._read()
                self.idle()
            except OSError:         # the line was cut
                self._decoder.reset()
                self._closing.wait(0.005)

    def _read(self):
        data = self.line.read(self.POLL)
        now = time.monotonic()
        frames = []
        with self._recording:       # all of one read is recorded, or forgotten
            wire, valid, bad = self.wire, self.frames, self.bad
        if data:
            self._last_byte = now
            wire.extend(data)
            frames = self._decoder.feed(data, now)
        elif now > self._last_byte + _GIVE_UP:
            frames = self._decoder.give_up()
        for frame in frames:
            if frame.cause:
                bad.append(frame)
            else:
                valid.append(frame)
                self.take(frame)


class BusBoard(FakeBus, Board):
    """The main control board."""

    def __init__(self, line, **manners):
        FakeBus.__init__(self, **manners)
        Board.__init__(self, line, bus.RequestDecoder())

    @property
    def others(self):
        """The bytes of the frames that are neither SYNC nor ECHO."""
        return [frame.raw for frame in list(self.frames) if frame.type not in (bus.SYNC, bus.ECHO)]

    def requests(self, cmd1=None):
        """The requests so far."""
        return [request for request in self.messages() if cmd1 in (None, request.cmd1)]

    def moves(self):
        """Lift, gimbal and raw requests, in their order."""
        return [request for request in self.requests(bus.FUNCTION)
                if request != bus.ENVIRONMENT_REQUEST]


class CarBoard(Board):
    """The model car, which does not move at first. With `streaming` it sends IMU packets all the
    time.

    A SPEED 0 while the speed is 0 is a repetition, which is a frame but no command. Once the car
    has sent something by `write` or `say`, it is never silent as long as it gets heartbeats, since
    the bridge refuses commands to a silent board: it sends empty packets, which are nothing.
    """

    IMU = arduino.encode(arduino.Imu(16384, *[0] * 10))
    POLL = 0.005

    def __init__(self, line, messages=()):
        self.streaming = False
        self._speed = 0
        self._wrote_at = float('inf')
        super().__init__(line, arduino.BoardDecoder(messages=messages))

    def forget(self):
        super().forget()
        self.command_frames = []

    def take(self, frame):
        message = frame.message
        if isinstance(message, arduino.SpeedCommand):
            before, self._speed = self._speed, message.value
            if before == message.value == 0:
                return
        if not isinstance(message, arduino.Heartbeat):
            self.command_frames.append(frame)
        elif time.monotonic() > self._wrote_at + _QUIET:
            self.write(b'\0')

    def idle(self):
        if self.streaming:
            self.line.write(self.IMU)

    def write(self, data):
        self._wrote_at = time.monotonic()
        return super().write(data)

    def say(self, message):
        """Send a typed message."""
        self.write(arduino.encode(message))

    def commands(self):
        """The messages that are neither heartbeats nor repetitions of SPEED 0."""
        return [frame.message for frame in list(self.command_frames)]

    @property
    def raw_commands(self):
        """The bytes of these messages."""
        return [frame.raw for frame in list(self.command_frames)]

    @property
    def speeds(self):
        """The values of the speed commands among them."""
        return [message.value for message in self.commands()
                if isinstance(message, arduino.SpeedCommand)]

    def heartbeats(self):
        """How many were received."""
        return len(self.messages(arduino.Heartbeat))

    @property
    def heartbeat_times(self):
        """When each was received, by time.monotonic()."""
        return [frame.stamp for frame in list(self.frames)
                if isinstance(frame.message, arduino.Heartbeat)]

    def wait_for_heartbeats(self, number):
        """Wait for that many heartbeats from now on."""
        wanted = self.heartbeats() + number
        waiting.until(lambda: self.heartbeats() >= wanted, '%d heartbeats' % number)

    def wait_for_heartbeat_rate(self, least, most, number=100):
        """Wait until the rate of `number` heartbeats is between these limits, in Hz.

        A stall of this machine lowers only the rate of the heartbeats that it delays.
        """
        def measured():
            self.forget()
            self.wait_for_heartbeats(number)
            stamps = self.heartbeat_times
            seconds = stamps[-1] - stamps[0]
            return least * seconds < len(stamps) - 1 < most * seconds
        waiting.until(measured, 'heartbeats at %g to %g Hz' % (least, most))


class SensorBoard(Board):
    """The board with the range sensors. Nothing is sent to it: `wire` must stay empty."""

    def __init__(self, line):
        self.seq = 0
        super().__init__(line, mcu.Decoder())

    def say(self, message):
        """Send a typed message as the next frame."""
        self.write(mcu.encode(message, self.seq))
        self.seq = (self.seq + 1) % 256


def level_imu():
    """A plausible IMU packet, level and at rest."""
    return arduino.Imu(16384, 0, 0, 0, 0, 0, 0, 0, 0, 8192, 0)


def ranges(first=470, second=580, yaw=0.0, pitch=0.0, roll=0.0):
    """A sensor status."""
    return mcu.SensorStatus(first, second, yaw, pitch, roll)
