"""The lines between the bridge and the boards, whose far ends this process holds. Whatever can
happen to a line is a method here."""
import contextlib
import itertools
import os
import pty
import sched
import select
import socket
import termios
import threading
import time
import tty
from typing import Callable

_POLL = 20               # ms for which a reader waits, at most, before it looks around
_TICK = 0.002            # s
_SIZE = 65536            # bytes that are read at once
_HANDED_ON = 0.05        # s that a pseudo terminal may take to hand bytes on


class Clock(threading.Thread):
    """Calls functions at their times, by `time.monotonic`; of one time, the first first."""

    def __init__(self) -> None:
        super().__init__(name='clock', daemon=True)
        self._due = sched.scheduler(time.monotonic)
        self._numbers = itertools.count()
        self.start()

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        self.at(time.monotonic() + seconds, action)

    def at(self, when: float, action: Callable[[], None]) -> None:
        self._due.enterabs(when, next(self._numbers), action)

    def run(self) -> None:
        while True:
            self._due.run(blocking=False)
            time.sleep(_TICK)


class Line(threading.Thread):
    """A pseudo terminal under a name; `port` is what the bridge is given.

    Attributes:
        take: is called with what the bridge wrote and when it was read, by `time.monotonic`.
        cut: is called as the line is unplugged.
        to_bridge: what becomes of bytes on their way to the bridge.
    """

    _is_network = False

    def __init__(self, path: str) -> None:
        super().__init__(name=os.path.basename(path), daemon=True)
        self.port = path
        self.take: Callable[[bytes, float], None] = lambda data, now: None
        self.cut: Callable[[], None] = lambda: None
        self.to_bridge: Callable[[bytes], bytes] = lambda data: data
        self.frozen = False
        self._master = self._listener = -1
        self._device = ''        # of the bridge's end, which is `_slave`
        self._lock = threading.RLock()
        self._taken = 0          # bytes
        self.plug()
        self.start()

    def plug(self, another_name: bool = False) -> None:
        """It is there; with `another_name` as another device than before."""
        with self._lock:
            self._master, self._slave = pty.openpty()
            if another_name and os.ttyname(self._slave) == self._device:
                spare = self._master, self._slave
                self._master, self._slave = pty.openpty()
                for fd in spare:
                    os.close(fd)
            self._device = os.ttyname(self._slave)
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            os.symlink(self._device, self.port + '~')
            os.replace(self.port + '~', self.port)

    def unplug(self) -> None:
        """It is gone, with all that was on its way."""
        with self._lock:
            os.unlink(self.port)
            os.close(self._slave)
            self.frozen = False
            self._end()

    @property
    def plugged(self) -> bool:
        return self._master >= 0

    def freeze(self) -> None:
        """The board reads nothing any more, and the line has no room. To be called while the
        bridge is held: what it wrote before has been read, and what it writes next is refused."""
        self.drain()
        self.frozen = True
        while self.fill():      # until what was handed on has made no room any more
            time.sleep(_HANDED_ON)

    def fill(self) -> int:
        """Take the room that the bridge made as it dropped what waited; how many bytes there was
        room for. 0x00 means nothing."""
        fd, size = os.open(self.port, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK), 0
        for piece in 4096, 256, 1:      # where there is no room for much there may be for little
            with contextlib.suppress(BlockingIOError):
                while True:
                    size += os.write(fd, bytes(piece))
        os.close(fd)
        return size

    def flow(self, flows: bool) -> None:
        """Whether the bridge's end takes anything: flow control."""
        termios.tcflow(self._slave, termios.TCOON if flows else termios.TCOOFF)

    def thaw(self) -> None:
        self.frozen = False

    def drain(self) -> None:
        """Take all that the bridge has written, which does nothing meanwhile: a pseudo terminal
        hands it on a little later."""
        taken, self._taken = -1, 0
        while taken != self._taken:
            taken = self._taken
            time.sleep(_HANDED_ON)
            self.read_all()

    def write(self, data: bytes) -> bool:
        """From the board; False where the line is unplugged or has no room."""
        with self._lock:
            data = self.to_bridge(data)
            try:
                is_up = self.plugged and not (self._is_network and self.frozen)
                return is_up and os.write(self._master, data) == len(data)
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
                self._taken += len(data)
                self.take(data, time.monotonic())

    def run(self) -> None:
        while True:
            fd = self._master if self.plugged else self._listener
            if fd < 0 or self.frozen:
                time.sleep(_POLL / 1000)
            elif _ready(fd, select.POLLIN, _POLL):
                self.read_all()

    def _end(self) -> None:
        with self._lock:
            os.close(self._master)
            self._master = -1
            self.cut()


def _ready(fd: int, events: int, milliseconds: int) -> bool:
    poll = select.poll()
    poll.register(fd, events)
    return bool(poll.poll(milliseconds))


class NetworkLine(Line):
    """A TCP server in front of a board, as a converter on a robot is, with a network that fails.

    What a frozen network holds of a connection that has ended meanwhile is lost with it.
    """

    _is_network = True

    def plug(self, another_name: bool = False) -> None:
        self._server = socket.create_server(('127.0.0.1', 0))
        self._server.setblocking(False)
        self._listener = self._server.fileno()
        self.port = f'socket://127.0.0.1:{self._server.getsockname()[1]}'

    def vanish(self) -> None:
        with self._lock:
            self._master = -1       # which stays open: it says nothing, not even that it is over
            self.cut()

    def freeze(self) -> None:
        self.frozen = True

    def thaw(self) -> None:
        with self._lock:
            self.frozen = False
            self._end_if_ended()

    def _end_if_ended(self) -> None:
        if self.plugged and _ready(self._master, select.POLLRDHUP, 0):
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
                self._end_if_ended()        # while the network was frozen
            super().read_all()
