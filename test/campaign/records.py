"""What a campaign writes down while it runs, and how it is read afterwards.

    events.jsonl     the campaign itself: ports killed and returned, noise, phases
    calls.jsonl      each service call: arguments, start, end, answer
    commands.jsonl   each speed, steering and LED message, each calibration
    messages.bin     each message published, as it was serialized (but serial_msg)
    traffic.bin      serial_msg
    usage.jsonl      memory, threads and open files of the node
    bus.journal …    what each board saw and did: see serial_communication.simulation.journal
    log/             the node's log

Times are seconds of CLOCK_MONOTONIC, which all processes of a machine share.
"""
import json
import os
import struct
import threading
import time
from bisect import bisect_left
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Tuple

_HEAD = struct.Struct('<dHI')    # time of arrival, index of the topic, bytes that follow


class Lines:
    """Appends JSON objects, one a line; from any thread."""

    def __init__(self, path: str) -> None:
        self._file = open(path, 'a', buffering=1)
        self._lock = threading.Lock()

    def write(self, **fields: Any) -> None:
        """One line."""
        line = json.dumps(fields, separators=(',', ':')) + '\n'
        with self._lock:
            self._file.write(line)

    def close(self) -> None:
        """No more."""
        with self._lock:
            self._file.close()


def read_lines(path: str) -> List[Dict[str, Any]]:
    """All whole lines of a file; none where there is no file."""
    if not os.path.exists(path):
        return []
    found = []
    with open(path) as file:
        for line in file:
            try:
                found.append(json.loads(line))
            except ValueError:
                pass    # cut off as its writer was ended
    return found


class Message(NamedTuple):
    """One message as it was received."""

    t: float        # of its arrival
    topic: str
    data: bytes     # serialized


class MessageFile:
    """Writes messages of some topics; any thread."""

    def __init__(self, path: str, topics: List[str]) -> None:
        self._index = {name: index for index, name in enumerate(topics)}
        self._file = open(path, 'wb', buffering=1 << 18)
        self._lock = threading.Lock()
        head = {'topics': topics, 'offset': time.time() - time.monotonic()}
        self._file.write(json.dumps(head).encode() + b'\n')

    def write(self, topic: str, data: bytes) -> None:
        """A message has come."""
        now = time.monotonic()
        with self._lock:
            if not self._file.closed:
                self._file.write(_HEAD.pack(now, self._index[topic], len(data)) + data)

    def flush(self) -> None:
        with self._lock:
            self._file.flush()

    def close(self) -> None:
        with self._lock:
            self._file.close()


def read_messages(path: str) -> Tuple[float, Iterator[Message]]:
    """Wall clock minus monotonic clock, and the messages in their order."""
    file = open(path, 'rb')
    head = json.loads(file.readline().decode())
    return head['offset'], _messages(file, head['topics'])


def _messages(file, topics: List[str]) -> Iterator[Message]:
    with file:
        while True:
            head = file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                return
            t, index, size = _HEAD.unpack(head)
            data = file.read(size)
            if len(data) < size:
                return
            yield Message(t, topics[index], data)


def stretches(events: List[Dict], begins: str, ends: str, end: float,
              link: str = '') -> 'Intervals':
    """From each event `begins` of that link to the next `ends`; to `end` where there is none."""
    pairs, since = [], None
    for event in events:
        if event.get('link', '') != link:
            continue
        if event['ev'] == begins and since is None:
            since = event['t']
        elif event['ev'] == ends and since is not None:
            pairs.append((since, event['t']))
            since = None
    return Intervals(pairs + ([] if since is None else [(since, max(end, since))]))


class Intervals:
    """Stretches of time, for asking whether another one touches them."""

    def __init__(self, pairs=()) -> None:
        self.pairs: List[Tuple[float, float]] = []
        for start, end in sorted(pairs):
            if self.pairs and start <= self.pairs[-1][1]:
                self.pairs[-1] = (self.pairs[-1][0], max(end, self.pairs[-1][1]))
            else:
                self.pairs.append((start, end))
        self._ends = [end for _start, end in self.pairs]

    def touches(self, start: float, end: float) -> bool:
        """Whether some moment of start … end lies in one of them."""
        at = bisect_left(self._ends, start)
        return at < len(self.pairs) and self.pairs[at][0] <= end

    def holds(self, t: float) -> bool:
        return self.touches(t, t)

    def first_within(self, start: float, end: float) -> Optional[Tuple[float, float]]:
        """The first that begins at `start` or later, if it is over by `end`."""
        at = bisect_left(self.pairs, (start, start))
        return self.pairs[at] if at < len(self.pairs) and self.pairs[at][1] <= end else None

    def seconds(self) -> float:
        """Their length in all."""
        return sum(end - start for start, end in self.pairs)

    def seconds_within(self, start: float, end: float) -> float:
        """How much of start … end they cover."""
        return sum(max(0.0, min(end, stop) - max(start, began)) for began, stop in self.pairs)

    def longer(self, seconds: float) -> 'Intervals':
        """Each of them, and so long after it."""
        return Intervals([(start, end + seconds) for start, end in self.pairs])

    def __add__(self, other: 'Intervals') -> 'Intervals':
        return Intervals(self.pairs + other.pairs)
