"""Reading ports live. Decoding, printing and recording never delay the reading.

Each port has a thread that only reads, forwards, and puts what it read into bounded queues without
waiting. Decoding, printing and recording run in other threads.
"""
import os
import queue
import threading
import time
from typing import Any, Callable, List, NamedTuple, Optional, Sequence, Union

from ...framing.custom_messages import CustomMessage
from ...framing.settings import Setting, message_of
from ...framing.stream import Frame
from ...link.stall import AFTER_STALL, STALL
from ...transport import pace
from ...transport.opener import Opener
from ...transport.port import Port, PortError
from ..ports.holders import holders_of
from . import recording
from .announced import Learner
from .forwarder import Forwarder
from .lines import Direction, Settings
from .recording import Read
from .show import WireError, print_note

_MOST_WAITING = 10000    # reads in an inbox; further ones are left out
_FLUSH = 0.5             # s until a read is in the file, at most
_TICK = 0.05             # s that a read of a port waits, at most
_AFTER_OPENING = 0.1     # s in which a tap drops what a port has as it opens
# s that decoding waits, at most: a signal that arrives just before a wait begins does not end it.
_LONGEST_WAIT = 1.0
_REALTIME_PRIORITY = 15


class Event(NamedTuple):
    """Something to report about a port."""

    at: float
    sent: bool     # True: the computer's port; False: the board's
    text: str
    lost: bool     # bytes are missing: a frame that began before does not continue


Item = Union[Read, Event]


class Inbox:
    """A bounded queue of reads and events; `put` never blocks."""

    def __init__(self) -> None:
        self._queue: 'queue.SimpleQueue[Item]' = queue.SimpleQueue()
        self._left_out = 0

    def put(self, item: Item) -> None:
        """Add an item, or leave it out and count it if the queue is full."""
        if self._queue.qsize() >= _MOST_WAITING:
            self._left_out += 1
            return
        if self._left_out:
            left_out, self._left_out = self._left_out, 0
            self._queue.put(Event(item.at, item.sent,
                                  f'{left_out} reads are left out here: this program was too slow',
                                  True))
        self._queue.put(item)

    def get(self, timeout: float) -> Optional[Item]:
        """Return the next item, or None after `timeout` s."""
        try:
            return self._queue.get(timeout=max(timeout, 0.0))
        except queue.Empty:
            return None


class PortReader:
    """Reads one port until `stop`, and opens it again whenever it vanishes.

    Bytes that waited in a port during a stall (this program was suspended, or got no processor
    time) are stale, but would be shown and forwarded as new. They are dropped and reported, and so
    are bytes that a tap finds in a port as it opens.

    Args:
        port: opened, read and closed by this object only.
        sent: whether the bytes read are sent to the board; False: by the board.
        inboxes: get every read and event.
    """

    def __init__(self, port: Port, sent: bool, inboxes: Sequence[Inbox]) -> None:
        self._port = port
        self._sent = sent
        self._inboxes = inboxes
        self._forwarder: Optional[Forwarder] = None     # forwards what this port reads
        self._reverse: Optional[Forwarder] = None       # writes to this port
        self._trouble = ''      # why the port is closed
        name = f'{"computer" if sent else "board"} port'
        self._opener = Opener(port, name + ' opening')
        self._stopping = self._opener.ending
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def lost(self) -> int:
        """The number of bytes that were not forwarded."""
        return self._forwarder.lost if self._forwarder else 0

    def connect(self, other: 'PortReader', line: Settings) -> None:
        """Forward what is read to the other reader's port. To be called before `start`."""
        self._forwarder = Forwarder(other._port, line, self._sent, self._report)
        other._reverse = self._forwarder

    def start(self) -> None:
        """Start the threads."""
        self._opener.start()
        self._thread.start()

    def stop(self) -> None:
        """Request the end; returns at once."""
        self._opener.end()

    def join(self) -> None:
        """Wait for the end after `stop`, for 1 s at most. The port is then closed."""
        self._thread.join(1.0)

    def _run(self) -> None:
        pace.set_priority(_REALTIME_PRIORITY)
        while self._opener.open(self._not_opened):
            self._trouble = ''
            try:
                self._serve()
            except PortError as error:
                self._trouble = str(error)
                self._report(f'{error}; opening it again when it returns', lost=True)
            self._port.close()
            if self._reverse:
                self._reverse.port_closed()

    def _not_opened(self, trouble: str) -> None:
        if trouble != self._trouble:
            self._trouble = trouble
            self._report(trouble)

    def _serve(self) -> None:
        if self._forwarder:
            self._drop_backlog(b'', 0.0)
        self._report('open')
        awake_at = pace.clock()
        if self._reverse:
            self._reverse.restart_silence_check()
        while not self._stopping.is_set():
            data = self._port.read(_TICK)
            stall = pace.clock() - awake_at
            if stall > STALL:
                self._drop_backlog(data, stall)
                data = b''
            awake_at, now = pace.clock(), time.monotonic()
            if self._forwarder:
                self._forwarder.forward(data, now)
            if data:
                self._put(Read(now, self._sent, data))
            if self._reverse and stall > STALL:
                self._reverse.restart_silence_check()
            elif self._reverse:
                self._reverse.check_silence(bool(data), now)

    def _drop_backlog(self, data: bytes, stall: float) -> None:
        """Drop what waits in the port after a stall of `stall` s, or, if 0, after it opened.

        `data` is what was read of it already.
        """
        awake_at = pace.clock()
        end = awake_at + (AFTER_STALL if stall else _AFTER_OPENING)
        dropped, stalled_for = len(data), stall
        while awake_at < end and not self._stopping.is_set():
            dropped += len(self._port.read(_TICK))
            stall, awake_at = pace.clock() - awake_at, pace.clock()
            if stall > STALL:
                end = awake_at + AFTER_STALL
                stalled_for += stall
        if not dropped:
            return
        remedy = ''
        if self._forwarder:
            self._forwarder.input_dropped(dropped, time.monotonic())
            remedy = self._forwarder.remedy
        when = f'while this program stalled for {stalled_for:.3g} s' if stalled_for else \
            'as it opened'
        self._report(f'{dropped} bytes that waited {when} were stale and dropped{remedy}',
                     lost=True)

    def _report(self, text: str, lost: bool = False) -> None:
        self._put(Event(time.monotonic(), self._sent, f'{self._port.url}: {text}', lost))

    def _put(self, item: Item) -> None:
        for inbox in self._inboxes:
            inbox.put(item)


class Recorder:
    """Writes the items of its inbox to a file, in its own thread.

    Args:
        path: the file, which is overwritten.
        line: the line that is recorded.
        began: seconds since 1970 at the time `start` of the items' clock.
        start: see `began`.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: str, line: Settings, began: float, start: float) -> None:
        self.inbox = Inbox()
        self.trouble = ''       # why writing has ended
        self._path = path
        self._start = start
        self._file = open(path, 'w', encoding='utf-8')
        self._file.write(recording.heading(line, began))
        self._file.flush()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='recorder', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Write the items that wait, and close the file; in 5 s at most."""
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
            self.trouble = f'{self._path}: {error.strerror}; recording has ended'
            print_note(self.trouble)


def decode_inbox(inbox: Inbox, line: Settings, until: Optional[float],
                 on_frame: Callable[[bool, Frame], None],
                 on_event: Callable[[Event], None]) -> None:
    """Decode the reads of an inbox, in this thread.

    Args:
        until: a time of the monotonic clock; None: for ever.
        on_frame: is called with (sent, frame).
        on_event: is called with each event.
    """
    directions = [Direction(line, sent) for sent in (False, True)]
    learner = Learner(line)

    def take(sent: bool, frame: Frame) -> None:
        on_frame(sent, frame)
        rows = learner.take(sent, frame)
        settings = [row for row in rows if isinstance(row, Setting)]
        decoders: List[Any] = [direction.decoder for direction in directions]
        for custom in rows:
            if isinstance(custom, CustomMessage):     # others change nothing that is shown live
                decoders[custom.is_command].add_message(custom.kind)
        for decoder in decoders if settings else ():
            decoder.add_message(message_of(settings))

    while True:
        times = [until, *(direction.due() for direction in directions)]
        item = inbox.get(min([_LONGEST_WAIT, *(time_ - time.monotonic() for time_ in times
                                               if time_ is not None)]))
        now = time.monotonic() if item is None else item.at
        if isinstance(item, Read):
            for frame in directions[item.sent].feed(item.data, item.at):
                take(item.sent, frame)
        for direction in directions:
            for frame in direction.expire(now):
                take(direction.sent, frame)
        if isinstance(item, Event):
            if item.lost:
                directions[item.sent].reset()
            on_event(item)
        if until is not None and now >= until:
            return


def claim(port: Port) -> None:
    """Open a port, if it exists.

    To be called at the start: an absent port is waited for later, but waiting does not free a port
    that another program has open.

    Raises:
        WireError: the port cannot be opened.
    """
    if not os.path.exists(port.url):
        return
    try:
        port.open()
    except PortError as error:
        holders = [str(holder) for holder in holders_of(port.url)]
        if not holders:
            raise WireError(f'{port.url}: {error}') from None
        raise WireError(f'{port.url} is open in {" and ".join(holders)}, and two readers of a port '
                        'take bytes from each other. End it first; or, if it is the bridge, look '
                        'at its frames: rostopic echo /serial_msg') from None
