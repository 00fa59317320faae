"""What the worst bytes that anyone can send cost, beside clean traffic: `bench --hostile`.

Twice: the decoder alone, in nanoseconds a byte; and the whole node, in CPU time a byte from the
port to its subscribers.
"""
import fcntl
import os
import pty
import select
import struct
import sys
import termios
import time
import tty
from typing import Any, Callable, Dict, List, NamedTuple

from processes import NODE, Child, Stage, StageError
from worst_streams import worst_streams

LINKS = 'bus', 'arduino', 'mcu'
TOPICS = {'arduino': [f'/{NODE}/{name}' for name in (
    'ticks', 'steering_angle', 'voltage', 'imu', 'imu/temperature')],
    'mcu': ['/mcu/' + name for name in ('status', 'imu', 'range_1', 'range_2')]}
LIMIT = 5.0              # times the cost of clean traffic
READ = 4096              # bytes; what a tty gives at once
_SIZE = 1 << 20          # bytes for a decoder
_NODE_SIZE = 1 << 18     # bytes for the node
_SETTLED = 0.15          # CPU s a second below which the node has nothing to do
_CALM = 5                # tenths of a second for which it has not
_NODES_STREAMS = 4       # of the worst ones of each link


class Cost(NamedTuple):
    """Of one stream."""

    link: str
    name: str
    clean: float     # ns a byte
    worst: float

    @property
    def ratio(self) -> float:
        return self.worst / max(self.clean, 1e-9)


def decoder_costs(size: int = _SIZE) -> List[Cost]:
    """Of every stream."""
    cleans: Dict[str, float] = {}
    costs = []
    for stream in worst_streams(size):
        if stream.link not in cleans:
            cleans[stream.link] = _nanoseconds(stream.decoder, stream.clean)
        costs.append(Cost(stream.link, stream.name, cleans[stream.link],
                          _nanoseconds(stream.decoder, stream.worst)))
    return costs


def hostile() -> bool:
    """All of it: prints what each stream costs; whether none costs too much."""
    decoders = decoder_costs()
    print(render_costs('decoder', decoders), end='\n\n')
    stage = Stage('serial_communication_bench_')
    try:
        with stage:
            nodes = node_costs(stage, decoders)
    finally:
        stage.discard()
    print(render_costs('whole node', nodes), end='\n\n')
    too_much = [f'{cost.link}, {cost.name}: {cost.ratio:.1f} times clean traffic'
                for cost in decoders + nodes if cost.ratio > LIMIT]
    print('\n'.join(too_much) or f'every stream costs at most {LIMIT:g} times clean traffic')
    return not too_much


def node_costs(stage: Stage, costs: List[Cost]) -> List[Cost]:
    """Of the streams that cost a decoder most, for a node with a subscriber of all its topics."""
    found = []
    streams = {(stream.link, stream.name): stream for stream in worst_streams(_NODE_SIZE)}
    for link in LINKS:
        worst = sorted((cost for cost in costs if cost.link == link),
                       key=lambda cost: -cost.worst)[:_NODES_STREAMS]
        feeder = _Feeder(stage, link)
        clean_stream = streams[link, worst[0].name].clean
        if link != 'bus':       # which publishes nothing that nobody asked for
            subscriber = stage.child(f'subscriber {link}', ['rostopic', 'hz', *TOPICS[link]])
            for _ in range(30):
                feeder.cost(clean_stream)
                if 'min_delta' in subscriber.tail():
                    break
            else:
                raise StageError('nothing is published')
        clean = feeder.cost(clean_stream)
        for cost in worst:
            print(f'{link}: {cost.name}', file=sys.stderr)
            found.append(Cost(link, cost.name, clean,
                              feeder.cost(streams[link, cost.name].worst)))
        stage.clear()
        feeder.close()
    return found


def render_costs(title: str, costs: List[Cost]) -> str:
    """One line a stream."""
    lines = [f'{title:18} {"stream":56} {"clean ns/B":>12} {"worst ns/B":>12} {"times":>7}']
    lines += [f'{cost.link:18} {cost.name:56} {cost.clean:12.0f} {cost.worst:12.0f} '
              f'{cost.ratio:7.1f}' for cost in costs]
    return '\n'.join(lines)


def _nanoseconds(make: Callable[[], Any], stream: bytes) -> float:
    """CPU time of this thread, a byte."""
    decoder = make()
    pieces = [stream[at:at + READ] for at in range(0, len(stream), READ)]
    began = time.thread_time()
    for piece in pieces:
        decoder.feed(piece)
    return (time.thread_time() - began) / len(stream) * 1e9


class _Feeder:
    """A node whose port is the end of a pty that we hold."""

    def __init__(self, stage: Stage, link: str) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self._slave = slave
        os.set_blocking(self._master, False)
        self._node: Child = stage.bridge({link: os.ttyname(slave)}, {
            'bus/environment_period': 0.0, 'publish_tf': True}, name='bridge_' + link)
        time.sleep(1.5)

    def cost(self, stream: bytes) -> float:
        """CPU ns of the node for each byte."""
        self._wait_until_taken()
        idle = self._idle()
        began, before = time.monotonic(), self._node.cpu_seconds()
        at = 0
        while at < len(stream):
            if not select.select([], [self._master], [], 20.0)[1]:
                raise StageError(f'the node takes no bytes: {self._node.tail()}')
            try:
                at += os.write(self._master, stream[at:at + READ])
            except BlockingIOError:
                time.sleep(0.001)
            self._drain()
        self._wait_until_taken()
        took = time.monotonic() - began
        return max(self._node.cpu_seconds() - before - idle * took, 0.0) / len(stream) * 1e9

    def _idle(self) -> float:
        """CPU s a second without any bytes."""
        before, began = self._node.cpu_seconds(), time.monotonic()
        while time.monotonic() < began + 1.0:
            time.sleep(0.05)
            self._drain()
        return (self._node.cpu_seconds() - before) / (time.monotonic() - began)

    def _wait_until_taken(self) -> None:
        """Until nothing waits in the port and the node has nothing to do for a while."""
        calm = 0
        while calm < _CALM:
            before = self._node.cpu_seconds()
            time.sleep(0.1)
            self._drain()
            waiting = struct.unpack('i', fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)))[0]
            calm = 0 if waiting or self._node.cpu_seconds() - before > _SETTLED * 0.1 else calm + 1

    def _drain(self) -> None:
        try:
            os.read(self._master, 1 << 16)
        except BlockingIOError:
            pass

    def close(self) -> None:
        """The node has ended."""
        os.close(self._master)
        os.close(self._slave)
