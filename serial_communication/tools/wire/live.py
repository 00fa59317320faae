"""Ports that are read as bytes come, and those who look on, who can never hold that up.

A thread a port does nothing but read, pass on, and put what it read into queues that have an end
and never make it wait. Whoever decodes, prints or keeps it does so in a thread of its own.
"""
import os
import queue
import threading
import time
from typing import Callable, List, NamedTuple, Optional, Sequence, Union

from ...framing.stream import Frame
from ...link.backlog import STALL, Backlog
from ...transport import pace
from ...transport.opener import Opener
from ...transport.port import Port, PortError
from . import recording
from .lines import Direction, Settings
from .passing import Passage
from .recording import Read
from .show import Trouble, complain

_MOST_WAITING = 10000    # reads that wait for one who looks on; what comes then is left out
_FLUSH = 0.5             # s that a read waits at most to reach a file
_TICK = 0.05             # s from one look at a port to the next, at most
_REALTIME_PRIORITY = 15


class Event(NamedTuple):
    """Something about a port that people are to know."""

    at: float
    sent: bool     # of the computer's end; False: of the board's
    text: str
    lost: bool     # what began before it does not go on behind it


Item = Union[Read, Event]


class Inbox:
    """What waits for one who looks on. Bounded; `put` never waits."""

    def __init__(self) -> None:
        self._queue: 'queue.SimpleQueue[Item]' = queue.SimpleQueue()
        self._left_out = 0

    def put(self, item: Item) -> None:
        """Have it seen, unless too much waits."""
        if self._queue.qsize() >= _MOST_WAITING:
            self._left_out += 1
            return
        if self._left_out:
            left_out, self._left_out = self._left_out, 0
            self._queue.put(Event(item.at, item.sent,
                                  f'{left_out} reads are left out here: this was too slow', True))
        self._queue.put(item)

    def get(self, timeout: Optional[float]) -> Optional[Item]:
        """The next, or None after `timeout` s."""
        try:
            return self._queue.get(timeout=None if timeout is None else max(timeout, 0.0))
        except queue.Empty:
            return None


class PortReader:
    """Reads one port until `stop`, opening it again whenever it vanishes.

    What waited in a port during a stall (this program was suspended, or got no processor time) is
    old, and would be shown and passed on as new: it is dropped, and reported. Likewise what a port
    of a tap has as it opens.

    Args:
        port: opened, read and closed here, nowhere else.
        sent: what comes is sent to the board; False: by the board.
        inboxes: of those who look on.
    """

    def __init__(self, port: Port, sent: bool, inboxes: Sequence[Inbox]) -> None:
        self._port = port
        self._sent = sent
        self._inboxes = inboxes
        self._onward: Optional[Passage] = None     # what comes is passed on by this …
        self._back: Optional[Passage] = None       # … and this leads to the port
        self._trouble = ''      # why the port is closed
        name = f'{"computer" if sent else "board"} port'
        self._opener = Opener(port, name + ' opening')
        self._stopping = self._opener.ending
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def lost(self) -> int:
        """Bytes that were not passed on."""
        return self._onward.lost if self._onward else 0

    def connect(self, other: 'PortReader', line: Settings) -> None:
        """Pass what comes on to another's port; to be called before `start`."""
        self._onward = Passage(other._port, line, self._sent, self._tell)
        other._back = self._onward

    def start(self) -> None:
        """Begin."""
        self._opener.start()
        self._thread.start()

    def stop(self) -> None:
        """Begin to end; returns at once."""
        self._opener.end()
        self._port.wake()

    def join(self) -> None:
        """After `stop`: the port is closed when this returns."""
        self._thread.join(1.0)

    def _run(self) -> None:
        pace.set_priority(_REALTIME_PRIORITY)
        while self._opener.open(self._not_opened):
            self._trouble = ''
            try:
                self._serve()
            except PortError as error:
                self._trouble = str(error)
                self._tell(f'{error}; opening it again when it returns', lost=True)
            self._port.close()
            if self._back:
                self._back.broken()

    def _not_opened(self, trouble: str) -> None:
        if trouble != self._trouble:
            self._trouble = trouble
            self._tell(trouble)

    def _serve(self) -> None:
        if self._onward:
            self._drop_old(b'', 0.0)
        self._tell('open')
        awake_at = pace.clock()
        if self._back:
            self._back.listens(time.monotonic())
        while not self._stopping.is_set():
            data = self._port.read(_TICK)
            stall = pace.clock() - awake_at
            if stall > STALL:
                self._drop_old(data, stall)
                data = b''
            awake_at, now = pace.clock(), time.monotonic()
            if self._onward:
                self._onward.pass_on(data, now)
            if data:
                self._put(Read(now, self._sent, data))
            if self._back and stall > STALL:
                self._back.listens(now)
            elif self._back:
                self._back.look_at_silence(bool(data), now)

    def _drop_old(self, data: bytes, stall: float) -> None:
        """Drop what waits in the port after a stall of so many s, or after it opened; `data` has
        been read."""
        awake_at = pace.clock()
        backlog = Backlog(self._port.baud, stall, awake_at)
        while not backlog.drop(data, awake_at) and not self._stopping.is_set():
            data = self._port.read(_TICK)
            stall, awake_at = pace.clock() - awake_at, pace.clock()
            if stall > STALL:
                backlog.extend(stall, awake_at)
        if not backlog.size:
            return
        remedy = ''
        if self._onward:
            self._onward.interrupted(backlog.size, time.monotonic())
            remedy = self._onward.remedy
        when = f'while this program stalled for {backlog.seconds:.3g} s' if backlog.seconds else \
            'as it opened'
        self._tell(f'{backlog.size} bytes that waited {when} are old and dropped{remedy}',
                   lost=True)

    def _tell(self, text: str, lost: bool = False) -> None:
        self._put(Event(time.monotonic(), self._sent, f'{self._port.url}: {text}', lost))

    def _put(self, item: Item) -> None:
        for inbox in self._inboxes:
            inbox.put(item)


class Recorder:
    """Writes what an inbox gets to a file, in a thread of its own.

    Args:
        began: seconds since 1970 at the time `start` of the items' clock.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: str, line: Settings, began: float, start: float) -> None:
        self.inbox = Inbox()
        self.trouble = ''       # why nothing more is written
        self._path = path
        self._start = start
        self._file = open(path, 'w', encoding='utf-8')
        self._file.write(recording.heading(line, began))
        self._file.flush()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='recorder', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Write what waits, and close the file."""
        self._stopping.set()
        self._thread.join(5.0)

    def _run(self) -> None:
        try:
            with self._file as file:
                while True:
                    item = self.inbox.get(0.0 if self._stopping.is_set() else _FLUSH)
                    if isinstance(item, Read):
                        file.write(recording.read_line(item, self._start))
                    elif item:
                        file.write(f'# {item.at - self._start:.6f} {item.text}\n')
                    elif self._stopping.is_set():
                        break
                    else:
                        file.flush()
        except OSError as error:
            self.trouble = f'{self._path}: {error.strerror}; no more of it is written'
            complain(self.trouble)


def watch(inbox: Inbox, line: Settings, until: Optional[float],
          on_frame: Callable[[bool, Frame], None], on_event: Callable[[Event], None]) -> None:
    """Decode what an inbox gets, in this thread, until that time of the monotonic clock."""
    directions = [Direction(line, sent) for sent in (False, True)]
    while True:
        times = [time_ for time_ in [until] + [direction.due() for direction in directions]
                 if time_ is not None]
        item = inbox.get(min(times) - time.monotonic() if times else None)
        now = time.monotonic() if item is None else item.at
        if isinstance(item, Read):
            for frame in directions[item.sent].hear(item.data, item.at):
                on_frame(item.sent, frame)
        for direction in directions:
            for frame in direction.silent_until(now):
                on_frame(direction.sent, frame)
        if isinstance(item, Event):
            if item.lost:
                directions[item.sent].reset()
            on_event(item)
        if until is not None and now >= until:
            return


def claim(port: Port) -> None:
    """Open a port that is there; an absent one is left.

    To be called before a program begins: what is not there yet is waited for, but a port that
    another program has does not become free by waiting.

    Raises:
        Trouble: it cannot be opened.
    """
    if not os.path.exists(port.url):
        return
    try:
        port.open()
    except PortError as error:
        holders = users_of(port.url)
        if not holders:
            raise Trouble(f'{port.url}: {error}') from None
        raise Trouble(f'{port.url} is open in {" and ".join(holders)}, and two readers of a port '
                      'take bytes from each other. End it first; or, if it is the bridge, look at '
                      'what it sees: rostopic echo /serial_msg') from None


def users_of(path: str) -> List[str]:
    """The programs that have a port for themselves, as far as we may see: `name (pid 12)`."""
    found = []
    try:
        port = os.stat(path)
        inode = f'{os.major(port.st_dev):02x}:{os.minor(port.st_dev):02x}:{port.st_ino}'
        with open('/proc/locks') as locks:
            pids = [words[4] for words in map(str.split, locks)
                    if words[1] == 'FLOCK' and words[5] == inode]
        for pid in pids:
            with open(f'/proc/{pid}/cmdline', 'rb') as file:
                words = file.read().decode('utf-8', 'replace').split('\0')
            found.append(f'{_program(words)} (pid {pid})')
    except (OSError, IndexError):
        pass     # it has just ended, or this system does not tell
    return found


def _program(words: List[str]) -> str:
    """Of a command line: not the interpreter, but what it runs."""
    names = [os.path.basename(word) for word in words if word]
    if len(names) > 1 and names[0].startswith('python') and not words[1].startswith('-'):
        return names[1]
    return names[0] if names else '?'
