"""The boards of the bench, each a child process at the master end of a pty.

    talker   sends a board's packets: at jittered times, or back to back
    listener blocks in read and stamps each heartbeat
    bus      answers requests, at the pace of a wire
"""
import os
import select
import sys
import threading
import time
from typing import Callable, Dict, List

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from .child import be_a_board, jittered, serve, sleep_until, wait_until

BITS = 10              # of a byte on the wire, start and stop bit included
COUNT = 1024           # a running number in a packet is modulo this
_BAUD = 115200         # of the bus
_CHUNK = 0.001         # s of wire time in one write, as a USB adapter hands it over
_CATCH_UP = 0.004      # s of wire time in one write at most, after the talker itself was late
_FULL = 1 << 16        # bytes in one write at most


def arduino_turn(n: int) -> List[bytes]:
    """What the car sends each 10 ms. The IMU's and the steering's packet hold the number."""
    return [arduino.encode(message) for message in (
        arduino.Imu(16384, 0, 0, 0, 10, -20, 30, 100, -200, n % COUNT, -1290),
        arduino.SteeringAngle(n % COUNT), arduino.Ticks(n % 256), arduino.Voltage(n % 8192 / 128))]


def mcu_turn(n: int) -> List[bytes]:
    """What the sensor board sends each 50 ms."""
    return [mcu.encode(mcu.SensorStatus(n % COUNT, 500, 12.34, -2.43, 2.43), n % 256)]


def imu_count(acceleration_z: float) -> int:
    """The running number in an Imu message."""
    return round(acceleration_z / (8 / 65536 * 9.81))


# Of each board that sends by itself: its packets, and its turns a second.
TURNS: Dict[str, Callable[[int], List[bytes]]] = {'arduino': arduino_turn, 'mcu': mcu_turn}
RATES = {'arduino': 100.0, 'mcu': 20.0}


class Talker:
    """Sends; what comes the other way is the listener's."""

    def __init__(self, fd: int, link: str) -> None:
        self._fd = fd
        self._turn = TURNS[link]
        self._rate = RATES[link]

    def talk(self, seconds: float) -> List[List[float]]:
        """Turns at jittered times, a write a packet; the times of writing of each turn."""
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

    def flood(self, baud: int, seconds: float) -> Dict[str, int]:
        """Whole packets without a gap; what the port does not take at once is lost."""
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


class Listener:
    """Stamps what the node sends: a heartbeat is all that the bench has it send."""

    HEARTBEAT = arduino.encode(arduino.Heartbeat())

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._stamps: List[float] = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            select.select([self._fd], [], [])    # the talker may have made it non-blocking
            data = os.read(self._fd, 4096)
            now = time.monotonic()
            self._stamps.extend([now] * data.count(self.HEARTBEAT))

    def take(self) -> List[float]:
        """Times of the heartbeats since it was asked before."""
        stamps, self._stamps = self._stamps, []
        return stamps


class BusBoard:
    """Answers every request when its bytes and the reply's have crossed the wire."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._decoder = bus.RequestDecoder()
        self._exchanges: List[tuple] = []
        threading.Thread(target=self._run, daemon=True).start()

    def take(self) -> List[tuple]:
        """Since it was asked before: (when a request's first byte was read, when its reply's last
        byte was about to be written)."""
        exchanges, self._exchanges = self._exchanges, []
        return exchanges

    def _run(self) -> None:
        began = 0.0
        while True:
            data = os.read(self._fd, 4096)
            now = time.monotonic()
            if not self._decoder.begun:
                began = now
            for frame in self._decoder.feed(data):
                if frame.cause:
                    continue
                reply = bus.encode_reply(_reply(frame.message))
                wait_until(began + (len(frame.raw) + len(reply)) * BITS / _BAUD)
                self._exchanges.append((began, time.monotonic()))
                os.write(self._fd, reply)


def _reply(request: bus.Request) -> bus.Reply:
    if request.cmd1 in (bus.SYNC, bus.ECHO):
        return bus.Reply(request.cmd1, request.data)
    if request == bus.ENVIRONMENT_REQUEST:
        return bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack())
    return bus.Reply(bus.OK)


def main() -> None:
    """boards ROLE FD [LINK]."""
    role, fd = sys.argv[1], int(sys.argv[2])
    sys.setswitchinterval(0.0005)
    # The listener is above the bridge's heartbeat, or it would stamp it late.
    be_a_board(30 if role == 'listener' else 5)
    if role == 'talker':
        talker = Talker(fd, sys.argv[3])
        serve(talk=talker.talk, flood=talker.flood)
    else:
        serve(take=(Listener if role == 'listener' else BusBoard)(fd).take)


if __name__ == '__main__':
    main()
