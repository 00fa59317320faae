"""The boards of the bench, each a child process at the master end of a pty.

    talker   sends packets of the arduino or the mcu: at jittered times, or back to back
    listener blocks in read and stamps each heartbeat
    timer    stamps a heartbeat of its own: what the machine itself does to one
    bus      answers requests, at the pace of a wire if asked to

Each value sent holds a running number, so that a subscriber's message finds its sending time.
"""
import os
import random
import sys
import threading
import time
from typing import Dict, List, Tuple

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.tools.watch.topics import TOPICS, Topic
from .child import be_a_board, jittered, serve, sleep_until, wait_until

BITS = 10              # of a byte on the wire, start and stop bit included
RAW_COMMAND = 0x40     # CMD2 of a function that only this board has
_CHUNK = 0.001         # s of wire time in one write, as a USB adapter hands it over
_CATCH_UP = 0.004      # s of wire time in one write at most, after the talker itself was late

# The topic of what is sent, and modulo what it counts: as far as its field goes.
COUNTED = {'~imu': 16384, '~ticks': 256, '~steering_angle': 1024, '~voltage': 8192,
           'mcu/status': 60000, '~environment': 65536}


def arduino_turn(n: int) -> List[Tuple[str, bytes]]:
    """What the car sends each 10 ms: (topic, packet)."""
    return [
        ('~imu', arduino.encode(arduino.Imu(16384, 0, 0, 0, 10, -20, 30, 100, -200,
                                            n % COUNTED['~imu'], -1290))),
        ('~ticks', arduino.encode(arduino.Ticks(n % COUNTED['~ticks']))),
        ('~steering_angle', arduino.encode(
            arduino.SteeringAngle(n % COUNTED['~steering_angle']))),
        ('~voltage', arduino.encode(arduino.Voltage(n % COUNTED['~voltage'] / 128))),
    ]


def mcu_turn(n: int) -> List[Tuple[str, bytes]]:
    """What the sensor board sends each 50 ms: (topic, frame)."""
    status = mcu.SensorStatus(n % COUNTED['mcu/status'], 500, 12.34, -2.43, 2.43)
    return [('mcu/status', mcu.encode(status, n % 256))]


def imu_count(acceleration_z: float) -> int:
    """The running number in an Imu message."""
    return round(acceleration_z / (8 / 65536 * 9.81))


TURNS = {'arduino': arduino_turn, 'mcu': mcu_turn}
LINKS = (*TURNS, 'bus')      # that the bench has boards for


def measured_topics(*links: str) -> List[Topic]:
    """The topics with what these boards send: all but those that come on change alone."""
    return [topic for link in links for topic in TOPICS if topic.links == (link,)
            and topic.ages and not topic.optional]


class Talker:
    """Sends; what comes the other way is the listener's."""

    def __init__(self, fd: int, link: str) -> None:
        self._fd = fd
        self._turn = TURNS[link]
        self._n = 0

    def talk(self, rate: float, seconds: float) -> Dict[str, list]:
        """Turns at jittered times, a write a packet; returns [number, time of writing] by name."""
        sent: Dict[str, list] = {}
        for due in jittered(time.monotonic(), rate, seconds):
            turn = self._turn(self._n)
            sleep_until(due)
            for name, packet in turn:
                sent.setdefault(name, []).append((self._n, time.monotonic()))
                try:
                    os.write(self._fd, packet)
                except BlockingIOError:
                    pass     # lost, as on a real line; the count of matches shows it
            self._n += 1
        return sent

    def flood(self, rate: float, seconds: float) -> Dict[str, float]:
        """`rate` bytes a second without a gap; what the port does not take at once is lost.

        Returns the whole packets, the bytes offered and lost, and the seconds it took.
        """
        os.set_blocking(self._fd, False)
        packets = [packet for n in range(4096) for _, packet in self._turn(n)]
        period = b''.join(packets)
        stream = memoryview(period + period[:1 << 16])
        ends, end = [], 0
        for packet in packets:
            end += len(packet)
            ends.append(end)
        start = last = time.monotonic()
        budget, offered, lost = 0.0, 0, 0
        wanted = rate * seconds
        while offered < wanted:
            sleep_until(last + _CHUNK)
            now = time.monotonic()
            budget += min(now - last, _CATCH_UP) * rate
            last = now
            size = min(int(budget), 1 << 16)
            at = offered % len(period)
            try:
                taken = os.write(self._fd, stream[at:at + size])
            except BlockingIOError:
                taken = 0
            lost += size - taken
            offered += size
            budget -= size
        elapsed = time.monotonic() - start
        rounds, rest = divmod(offered, len(period))
        whole = rounds * len(packets) + sum(1 for end in ends if end <= rest)
        if rest and rest not in ends:
            # End the packet that is cut off, or the next flood begins with half a packet.
            tail = stream[rest:min(end for end in ends if end > rest)]
            time.sleep(0.01)
            try:
                lost += len(tail) - os.write(self._fd, tail)
            except BlockingIOError:
                lost += len(tail)
            whole += 1
            offered += len(tail)
        return {'packets': whole, 'bytes': offered, 'lost': lost, 'seconds': elapsed}


class Listener:
    """Stamps what the node sends: a heartbeat is all that the bench has it send."""

    HEARTBEAT = arduino.encode(arduino.Heartbeat())

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._stamps: List[float] = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            data = os.read(self._fd, 4096)
            now = time.monotonic()
            self._stamps.extend([now] * data.count(self.HEARTBEAT))

    def begin(self) -> bool:
        """Forget what was before."""
        self._stamps = []
        return True

    def collect(self) -> List[float]:
        """Times of the heartbeats since `begin`."""
        return self._stamps


class Timer:
    """A bare 10 ms timer: how even any heartbeat could be on this machine at this time."""

    PERIOD = 0.01

    def __init__(self) -> None:
        self._stamps: List[float] = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            now = time.monotonic()
            self._stamps.append(now)
            due = max(due + self.PERIOD, now)
            sleep_until(due)

    def begin(self) -> bool:
        """Forget what was before."""
        self._stamps = []
        return True

    def collect(self) -> List[float]:
        """When it went off since `begin`."""
        return self._stamps


class BusBoard:
    """Answers every request. `byte_time` s a byte, both ways, then 0 … `delay` s of thinking."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._decoder = bus.RequestDecoder()
        self._n = 0
        self._byte_time = 0.0
        self._delay = 0.0
        self._exchanges: List[tuple] = []
        threading.Thread(target=self._run, daemon=True).start()

    def pace(self, byte_time: float, delay: float) -> bool:
        """From the next request on."""
        self._byte_time, self._delay = byte_time, delay
        return True

    def begin(self) -> bool:
        """Forget what was before."""
        self._exchanges = []
        return True

    def collect(self) -> List[tuple]:
        """Since `begin`: (number in the reply, when the request's first byte was read, when
        the reply's last byte was about to be written, bytes of both)."""
        return self._exchanges

    def _run(self) -> None:
        began = 0.0
        while True:
            data = os.read(self._fd, 4096)
            now = time.monotonic()
            if not self._decoder.pending:
                began = now
            for frame in self._decoder.feed(data):
                if frame.cause:
                    continue
                reply = bus.encode_reply(self._reply(frame.message))
                size = len(frame.raw) + len(reply)
                if self._byte_time or self._delay:
                    # The last byte is through when the whole wire time of both is over.
                    wait_until(began + size * self._byte_time + random.random() * self._delay)
                self._exchanges.append((self._n, began, time.monotonic(), size))
                os.write(self._fd, reply)
                self._n += 1

    def _reply(self, request: bus.Request) -> bus.Reply:
        if request.cmd1 in (bus.SYNC, bus.ECHO):
            return bus.Reply(request.cmd1, request.data)
        if request == bus.ENVIRONMENT_REQUEST:
            smoke = self._n % COUNTED['~environment']
            return bus.Reply(bus.OK, bus.Environment(smoke, 25.63, 48.12).pack())
        if request.cmd2 == RAW_COMMAND:
            return bus.Reply(bus.OK, self._n.to_bytes(4, 'little'))
        return bus.Reply(bus.OK)


def main() -> None:
    """boards ROLE FD [LINK]; timer has no FD."""
    role, fd = sys.argv[1], int((sys.argv + ['-1'])[2])
    sys.setswitchinterval(0.0005)
    if role == 'talker':
        be_a_board(5)
        talker = Talker(fd, sys.argv[3])
        serve(talk=talker.talk, flood=talker.flood)
    elif role == 'listener':
        be_a_board(30)     # above the node's heartbeat, or it would stamp it late
        listener = Listener(fd)
        serve(begin=listener.begin, collect=listener.collect)
    elif role == 'timer':
        be_a_board(30)
        timer = Timer()
        serve(begin=timer.begin, collect=timer.collect)
    else:
        be_a_board(5)
        board = BusBoard(fd)
        serve(pace=board.pace, begin=board.begin, collect=board.collect)


if __name__ == '__main__':
    main()
