"""The boards of the bench, each a child process at the controlling end of a pseudo terminal.

    talker   sends a board's packets, at jittered times or back to back
    listener reads and stamps each heartbeat
    bus      answers requests at the speed of a wire
"""
import math
import os
import select
import sys
import threading
import time
from typing import Callable, Dict, Iterable, List, Optional

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.stream import SETTING
from .child import jittered, serve, sleep_until, wait_until

BITS = 10              # for a byte on the wire, with start and stop bit
COUNT = 1024           # modulus of the running number in a packet
_BAUD = 115200         # of the bus
_CHUNK = 0.001         # s of wire time in one write, as from a USB adapter
_CATCH_UP = 0.004      # s of wire time in one write at most, if the talker is late
_FULL = 1 << 16        # bytes in one write at most


def arduino_turn(n: int) -> List[bytes]:
    """Return the packets of the car for one 10 ms turn; IMU and steering contain the number."""
    return [arduino.encode(message) for message in (
        arduino.Imu(16384, 0, 0, 0, 10, -20, 30, 100, -200, n % COUNT, -1290),
        arduino.SteeringAngle(n % COUNT), arduino.Ticks(n % 256), arduino.Voltage(n % 8192 / 128))]


def mcu_turn(n: int) -> List[bytes]:
    """Return the frames of the sensor board for one 50 ms turn."""
    return [mcu.encode(mcu.SensorStatus(n % COUNT, 500, 12.34, -2.43, 2.43), n % 256)]


def imu_count(acceleration_z: float) -> int:
    """Return the running number in an Imu message, from its acceleration in m/s²."""
    return round(acceleration_z / (8 / 65536 * 9.81))


# For each board that sends unasked: its packets, and its turns in Hz.
TURNS: Dict[str, Callable[[int], List[bytes]]] = {'arduino': arduino_turn, 'mcu': mcu_turn}
RATES = {'arduino': 100.0, 'mcu': 20.0}


class Talker:
    """Sends a board's packets. The listener reads the other direction."""

    def __init__(self, fd: int, link: str) -> None:
        self._fd = fd
        self._turn = TURNS[link]
        self._rate = RATES[link]
        self._booted = 0.0      # when the board's clock was 0

    def talk(self, seconds: float) -> List[List[float]]:
        """Send turns at jittered times, one write per packet; return the times of each turn."""
        sent = []
        for n, due in enumerate(jittered(time.monotonic(), self._rate, seconds)):
            packets = self._turn(n)
            sleep_until(due)
            times = []
            for packet in packets:
                times.append(time.monotonic())
                os.write(self._fd, packet)
            sent.append(times)
        return sent

    def boot(self) -> bool:
        """Let the board's clock begin anew."""
        self._booted = time.monotonic()
        return True

    def measure(self, seconds: float, ppm: Optional[float], batch: float) -> List[float]:
        """Send turns at jittered times; return when each was measured, in s since 1970.

        Args:
            ppm: how much too fast the board's clock is, whose time precedes each turn; None: none.
            batch: s; an adapter delivers at each multiple of it. 0.0: there is no adapter.
        """
        measured, ahead = [], time.time() - time.monotonic()
        for n, at in enumerate(jittered(time.monotonic(), self._rate, seconds)):
            sleep_until(math.ceil(at / batch) * batch if batch else at)
            if not batch:
                at = time.monotonic()
            packets = self._turn(n)
            if ppm is not None:
                packets.insert(0, arduino.encode(arduino.Time(
                    round((at - self._booted) * (1e6 + ppm)) % 2 ** 32, len(packets))))
            os.write(self._fd, b''.join(packets))
            measured.append(at + ahead)
        return measured

    def flood(self, baud: int, seconds: float) -> Dict[str, int]:
        """Send packets without gaps; count bytes as lost that the port does not take at once."""
        turns = round(baud / BITS * seconds / len(b''.join(self._turn(0))))
        data = memoryview(b''.join(packet for n in range(turns) for packet in self._turn(n)))
        os.set_blocking(self._fd, False)
        at = lost = 0
        budget, last = 0.0, time.monotonic()
        while at < len(data):
            sleep_until(last + _CHUNK)
            now = time.monotonic()
            budget += min(now - last, _CATCH_UP) * baud / BITS
            last = now
            chunk = data[at:at + min(int(budget), _FULL)]
            try:
                lost += len(chunk) - os.write(self._fd, chunk)
            except BlockingIOError:
                lost += len(chunk)
            at += len(chunk)
            budget -= len(chunk)
        return {'turns': turns, 'lost': lost}


class Recorder:
    """Keeps what a thread, which runs `records`, finds in the bytes of a node."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._kept: list = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            select.select([self._fd], [], [])    # the talker may have set it to non-blocking
            data = os.read(self._fd, 4096)
            self._kept.extend(self.records(data, time.monotonic()))

    def records(self, data: bytes, now: float) -> Iterable:
        """Yield what is to be kept of these bytes, read just now."""
        raise NotImplementedError

    def take(self) -> list:
        """Return the records since the last call."""
        kept, self._kept = self._kept, []
        return kept


class Listener(Recorder):
    """Records the time of each heartbeat of a node, and answers its settings."""

    HEARTBEAT = arduino.encode(arduino.Heartbeat())

    def __init__(self, fd: int) -> None:
        self._decoder = arduino.BoardDecoder()
        self._others = 0
        super().__init__(fd)

    def records(self, data: bytes, now: float) -> Iterable:
        beats = data.count(self.HEARTBEAT)
        if beats * len(self.HEARTBEAT) != len(data) or self._decoder.pending:
            for frame in self._decoder.feed(data):
                if frame.type == SETTING:
                    os.write(self._fd, frame.raw)
                self._others += len(frame.raw) * (frame.raw != self.HEARTBEAT)
        return [now] * beats

    def others(self) -> int:
        """Return the bytes besides heartbeats since the last call."""
        count, self._others = self._others, 0
        return count


class BusBoard(Recorder):
    """Answers each request after the wire time of its bytes and the reply's. Records the time at
    which the request's first byte was read, and that just before the reply was written."""

    def __init__(self, fd: int) -> None:
        self._decoder = bus.RequestDecoder()
        self._began = 0.0
        super().__init__(fd)

    def records(self, data: bytes, now: float) -> Iterable:
        if not self._decoder.begun:
            self._began = now
        for frame in self._decoder.feed(data):
            if not frame.cause:
                reply = bus.encode_reply(usual_reply(frame.message))
                wait_until(self._began + (len(frame.raw) + len(reply)) * BITS / _BAUD)
                yield self._began, time.monotonic()
                os.write(self._fd, reply)


def usual_reply(request: bus.Request) -> bus.Reply:
    """What the control board answers."""
    if request.cmd1 in (bus.SYNC, bus.ECHO):
        return bus.Reply(request.cmd1, request.data)
    return bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack()
                     if request == bus.ENVIRONMENT_REQUEST else b'')


def main() -> None:
    """boards ROLE FD [LINK]."""
    role, fd = sys.argv[1], int(sys.argv[2])
    sys.setswitchinterval(0.0005)
    if role == 'talker':
        talker = Talker(fd, sys.argv[3])
        serve(talk=talker.talk, boot=talker.boot, measure=talker.measure, flood=talker.flood)
    elif role == 'listener':
        listener = Listener(fd)
        serve(take=listener.take, others=listener.others)
    else:
        serve(take=BusBoard(fd).take)


if __name__ == '__main__':
    main()
