"""The lines to the bridge, held at their far ends. All that can happen to a line is a method."""
import asyncio
import contextlib
import functools
import os
import pty
import select
import socket
import threading
import time
import tty
from typing import Any, Callable, Iterator, List

from .writes import Writes

_POLL = 20               # ms that a reader waits at most until it checks the line's state
_SIZE = 65536            # bytes of one read
_PTY_DELAY = 0.05        # s that the kernel may take to move bytes through a pseudo terminal
_NOTED = 0.003           # s after the read of a frame until its write is known
_MOVED = 0.5             # s that the kernel may take to move a frame on a busy machine


class Clock:
    """Calls functions at given times of `time.monotonic`, in a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, name='clock', daemon=True).start()

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        self.at(time.monotonic() + seconds, action)

    def at(self, when: float, action: Callable[[], None]) -> None:
        self._loop.call_soon_threadsafe(self._loop.call_at, when, action)

    @contextlib.contextmanager
    def each(self, period: float, action: Callable[[], Any]) -> Iterator[None]:
        """Call this now and then each `period` s, until the end of the block."""
        active = [True]

        def act() -> None:
            if active:
                action()
                self.after(period, act)
        act()
        try:
            yield
        finally:
            active.clear()


class SerialLine(threading.Thread):
    """A pseudo terminal with a fixed name, `port`, which the bridge opens.

    Attributes:
        on_bytes: called with what the bridge wrote, and when it was read by `time.monotonic`.
        not_arrived: when the bridge wrote what was not read before the latest frames, in the last
            0.5 s.
        moved_late: those of them that must have been of the latest frames, for which there are no
            other writes: the kernel had moved them later than the bridge wrote the next ones.
        on_unplugged: called when the line is unplugged.
        on_moved: called with when the bridge wrote a frame, and when it was read.
        damage: returns what the bridge receives for bytes that the board sends.
    """

    def __init__(self, path: str) -> None:
        super().__init__(name=os.path.basename(path), daemon=True)
        self.port = path
        self.on_bytes: Callable[[bytes, float], None] = lambda data, now: None
        self.on_unplugged: Callable[[], None] = lambda: None
        self.on_moved: Callable[[float, float], None] = lambda written, now: None
        self.damage: Callable[[bytes], bytes] = lambda data: data
        self.frozen = False
        self._master = self._listener = -1
        self._device = ''        # name of `slave`, which is the bridge's end
        self._lock = threading.RLock()
        self._bytes_read = 0
        self.not_arrived: List[float] = []
        self.moved_late: List[float] = []
        self.plug()
        self.start()

    @functools.cached_property
    def _writes(self) -> Writes:
        return Writes()

    def plug(self, another_name: bool = False) -> None:
        """Make the port appear; with `another_name` it is another device than before."""
        with self._lock:
            self._master, self.slave = pty.openpty()
            if another_name and os.ttyname(self.slave) == self._device:
                spare = self._master, self.slave
                self._master, self.slave = pty.openpty()
                for fd in spare:
                    os.close(fd)
            self._device = os.ttyname(self.slave)
            tty.setraw(self.slave)
            os.set_blocking(self._master, False)
            self._writes.watch(self._device)
            self._forget_writes()
            os.symlink(self._device, self.port + '~')
            os.replace(self.port + '~', self.port)

    def unplug(self) -> None:
        """Make the port disappear, with all bytes on their way."""
        with self._lock:
            os.unlink(self.port)
            os.close(self.slave)
            self.frozen = False
            self._end()

    @property
    def plugged(self) -> bool:
        return self._master >= 0

    def drain(self) -> None:
        """Read all that a bridge has written that writes no more, however long the kernel delays
        it: until nothing comes, for 2 s at most."""
        deadline, before, self._bytes_read = time.monotonic() + 2.0, -1, 0
        while before != self._bytes_read and time.monotonic() < deadline:
            before = self._bytes_read
            time.sleep(_PTY_DELAY)
            self.read_all()

    def write(self, data: bytes) -> bool:
        """Send bytes to the bridge; False if the line is unplugged or full."""
        with self._lock:
            return self._write(self.damage(data))

    def _write(self, data: bytes) -> bool:
        try:
            return os.write(self._master, data) == len(data)
        except OSError:
            return False

    def read_all(self) -> None:
        with self._lock:
            while self.plugged and not self.frozen:
                try:
                    data = os.read(self._master, _SIZE)
                except OSError:
                    return
                if not data:
                    self._end()
                    return
                self._bytes_read += len(data)
                self._received(data)

    def _received(self, data: bytes) -> None:
        self.on_bytes(data, time.monotonic())

    def written(self, frames: int, now: float) -> List[float]:
        """When the bridge wrote so many frames that are read now: its latest writes. Of several
        frames in one write, or of one that is not noted, it is the time of another one."""
        if not frames:
            return []
        noted = self._noted + self._writes.next()
        while len(noted) < frames and time.monotonic() < now + _NOTED:
            noted += self._writes.next(_NOTED)
        # A later write is of a later frame, unless it is only noted later.
        before = max(sum(at <= now for at in noted),
                     min(sum(at <= now + _NOTED for at in noted), frames))
        self._noted = noted[before:]
        times = [min(at, now) for at in noted[:before]]
        lacking = max(0, frames - len(times))
        self.moved_late, waiting = self.not_arrived[:lacking], self.not_arrived[lacking:]
        times, found = times[:-frames], times[-frames:] or [now]
        self.not_arrived = [at for at in waiting if at > now - _MOVED] + times
        self.on_moved(found[0], now)
        return found[:1] * (frames - len(found)) + found

    def _forget_writes(self) -> None:
        self._writes.next()
        self._noted: List[float] = []       # of frames that are not read yet
        self.not_arrived = []

    def run(self) -> None:
        while True:
            fd = self._master if self.plugged else self._listener
            if fd < 0 or self.frozen:
                time.sleep(_POLL / 1000)
            elif _events(fd, _POLL):
                self.read_all()

    def _end(self) -> None:
        with self._lock:
            if self.plugged:
                os.close(self._master)
                self._master = -1
                self.on_unplugged()


def _events(fd: int, milliseconds: int) -> int:
    """What poll() reports for this descriptor; it waits for bytes to read."""
    poll = select.poll()
    poll.register(fd, select.POLLIN | select.POLLRDHUP)
    return sum(event for _fd, event in poll.poll(milliseconds))


class NetworkLine(SerialLine):
    """A TCP server in front of a board, like a serial server on a robot, with a network that fails.

    If a connection ends while the network is frozen, its unread bytes are lost.
    """

    def plug(self, another_name: bool = False) -> None:
        if self._listener >= 0:
            return
        self._server = socket.create_server(('127.0.0.1', 0))
        self._server.setblocking(False)
        self._listener = self._server.fileno()
        self.port = f'socket://127.0.0.1:{self._server.getsockname()[1]}'

    def unplug(self) -> None:
        """Close the connection; the server accepts another one."""
        with self._lock:
            self.frozen = False
            self._end()

    def write(self, data: bytes) -> bool:
        return not self.frozen and super().write(data)

    def freeze(self) -> None:
        self.frozen = True

    def thaw(self) -> None:
        with self._lock:
            self._forget_writes()
            self.frozen = False
            self._end_if_closed()

    def _end_if_closed(self) -> None:
        if self.plugged and _events(self._master, 0) & select.POLLRDHUP:
            self._end()

    def read_all(self) -> None:
        with self._lock:
            if not self.plugged and not self.frozen:
                try:
                    connection = self._server.accept()[0]
                except BlockingIOError:
                    return
                connection.setblocking(False)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._master = connection.detach()
                self._writes.watch_connection(self._master)
                self._forget_writes()
                self._end_if_closed()       # while the network was frozen
            super().read_all()
