"""The package's simulated boards at the far ends of lines, which also show what they receive, and
send what a test wants beside their measurements."""
import threading
from collections import deque

from serial_communication.boards.arduino import simulator as arduino_simulator
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import simulator as bus_simulator
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import simulator as mcu_simulator
from serial_communication.boards.mcu import wire as mcu
from serial_communication.simulation.board import Runner
from serial_communication.transport.port import Port, PortBusy, PortError
from waiting import until

_QUIET = 0.4    # s between two empty packets of a car
_BUILT_IN = bus.LIFT, bus.GIMBAL, bus.ANNOUNCEMENT.number
AIR = bus.Environment(350, 25.63, 48.12)


class Shown:
    """Records what a simulated board receives. It runs in a thread from its construction until
    `close`; its tty may vanish and return.

    Args:
        path: of the tty.
        options: of the simulated board.
    """

    def __init__(self, path, **options):
        self._recording = threading.RLock()
        self.forget()
        super().__init__(**options)
        self._port = Port(path)
        self._runner = Runner(self, self._port)
        self._thread = threading.Thread(target=self._runner.run, name=self.NAME, daemon=True)
        self._thread.start()

    @property
    def connected(self):
        """Whether its tty is open."""
        return self._port.is_open

    @property
    def raws(self):
        """The bytes of the valid frames."""
        return [frame.raw for frame in list(self.frames)]

    def messages(self, kind=object):
        """The messages received so far."""
        return [frame.message for frame in list(self.frames) if isinstance(frame.message, kind)]

    def forget(self):
        """Clear the records: all bytes, the valid frames and the invalid ones. The frames are
        stamped with time.monotonic()."""
        with self._recording:
            self.wire, self.frames, self.bad = bytearray(), [], []

    def receive(self, data, now):
        with self._recording:       # all of one read is recorded, or forgotten
            self.wire += data
            super().receive(data, now)

    def frame(self, frame, now):
        (self.bad if frame.cause else self.frames).append(frame)
        super().frame(frame, now)

    def write(self, data):
        """Write bytes; False if the tty is absent."""
        try:
            self._port.write(data)
        except (PortBusy, PortError):
            return False
        return True

    def close(self):
        """End the thread."""
        self._runner.stop()
        self._thread.join()


class BusBoard(Shown, bus_simulator.ControlBoard):
    """The control board, whose lift and gimbal move at once and without an end, and which has every
    function: each answers OK with the bytes in `data`, by its CMD2.

    `rule`, with each request, returns another answer than the usual one (None): a Reply, or b''
    for no answer. Requests other than SYNC, ECHO and environment take the next element of `script`,
    likewise.
    """

    def __init__(self, path, **options):
        self.air = AIR
        self.data = {}
        self.script = deque()
        self.rule = lambda request: None
        super().__init__(path, **{'lift_speed': 1e9, 'gimbal_speed': 1e9, **options})
        for axis in self.lift, self.pan, self.tilt:
            axis.limits = float('-inf'), float('inf')

    def frame(self, frame, now):
        request = frame.message
        answer = request and self.rule(request)
        if answer is None and request and request.cmd1 == bus.FUNCTION \
                and request != bus.ENVIRONMENT_REQUEST:
            answer = self.script.popleft() if self.script else None
            if answer is None and request.cmd2 not in _BUILT_IN:
                answer = bus.Reply(bus.OK, self.data.get(request.cmd2, b''))
        if answer is None:
            super().frame(frame, now)
        else:
            self.frames.append(frame)
            self.line.send(bus.encode_reply(answer) if answer else b'')

    def environment(self, now):
        return self.air

    def asked(self, cmd2):
        """The data of the requests of a function, in their order."""
        return [each.data for each in self.messages() if each[:2] == (bus.FUNCTION, cmd2)]


class CarBoard(Shown, arduino_simulator.ModelCar):
    """The model car. `command_frames` are those of its commands: neither heartbeats, nor SPEED 0
    where the speed is 0, which is a repetition.

    Args:
        measures: whether it sends measurements; else empty packets, since the bridge refuses
            commands to a silent board.
    """

    def __init__(self, path, measures=False, **options):
        self._measures, self._speed, self._talks_at = measures, 0, 0.0
        super().__init__(path, **options)

    def forget(self):
        with self._recording:
            super().forget()
            self.command_frames = []

    def frame(self, frame, now):
        message, is_repetition = frame.message, False
        if isinstance(message, arduino.SpeedCommand):
            is_repetition = message.value == self._speed == 0
            self._speed = message.value
        if message is not None and not isinstance(message, arduino.Heartbeat) \
                and not is_repetition:
            self.command_frames.append(frame)
        super().frame(frame, now)

    def advance(self, now):
        if now > self._talks_at:
            self._talks_at = now + _QUIET
            self.line.send_raw(b'\0')
        return super().advance(now)

    def _send_measured(self, *messages):
        if self._measures:
            super()._send_measured(*messages)

    def say(self, *messages):
        """Send messages, without another one between them; False if the tty is absent."""
        return self.write(b''.join(map(arduino.encode, messages)))

    def commands(self):
        """The messages of `command_frames`."""
        return [frame.message for frame in list(self.command_frames)]

    @property
    def speeds(self):
        """The values of the speed commands among them."""
        return [message.value for message in self.commands()
                if isinstance(message, arduino.SpeedCommand)]

    @property
    def heartbeat_times(self):
        """When each heartbeat was received, by time.monotonic()."""
        return [frame.stamp for frame in list(self.frames)
                if isinstance(frame.message, arduino.Heartbeat)]

    def heartbeats(self):
        """How many were received."""
        return len(self.heartbeat_times)

    def wait_for_heartbeats(self, number):
        """Wait for that many heartbeats from now on."""
        wanted = self.heartbeats() + number
        until(lambda: self.heartbeats() >= wanted, f'{number} heartbeats')


class SensorBoard(Shown, mcu_simulator.SensorBoard):
    """The sensor board; `measures` as that of the car."""

    def __init__(self, path, measures=False, **options):
        self._measures, self._own_seq = measures, 0
        super().__init__(path, **options)

    def advance(self, now):
        return super().advance(now) if self._measures else None

    def say(self, *messages):
        """Send messages as frames in a row; False if the tty is absent."""
        frames = [mcu.encode(message, (self._own_seq + index) % 256)
                  for index, message in enumerate(messages)]
        self._own_seq += len(messages)
        return self.write(b''.join(frames))


def level_imu():
    """A plausible IMU packet, level and at rest."""
    return arduino.Imu(16384, 0, 0, 0, 0, 0, 0, 0, 0, 8192, 0)


def ranges(first=470, second=580, yaw=0.0, pitch=0.0, roll=0.0):
    """A sensor status."""
    return mcu.SensorStatus(first, second, yaw, pitch, roll)
