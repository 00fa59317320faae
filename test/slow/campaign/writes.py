"""When the bridge writes to a line, noted by a process of its own, which no thread here delays.

The kernel moves the bytes of pseudo terminals in a thread of ordinary priority, so on a busy
machine they are read late, by up to 0.5 s. But it tells at once (inotify) when a program has
written to the device, as it does (epoll) when bytes have arrived on a connection. As a program
(arguments: descriptors of inotify, of epoll and of a pipe) it is that process.
"""
import contextlib
import ctypes
import os
import select
import signal
import struct
import subprocess
import sys
import time
from typing import List

_LIBC = ctypes.CDLL(None)
_MODIFIED = 2            # an event of inotify
_PR_SET_PDEATHSIG = 1
_PRIORITY = 30           # real-time, above the bridge's heartbeat
_RECORD = struct.Struct('qd')     # of which device or connection, and when


class Writes:
    """Notes when a program writes to a device, or to the other end of a connection."""

    def __init__(self) -> None:
        self._inotify, self._epoll = _LIBC.inotify_init1(0), select.epoll()
        self._watched, self._since = 0, 0.0
        self._epoll.register(self._inotify, select.EPOLLIN)
        self._times, end = os.pipe()
        os.set_blocking(self._times, False)
        passed = self._inotify, self._epoll.fileno(), end
        self._process = subprocess.Popen(       # Ctrl-C does not reach it
            [sys.executable, '-IS', __file__, *map(str, passed)], pass_fds=passed,
            start_new_session=True)
        os.close(end)

    def watch(self, device: str) -> None:
        """From now on return the writes to this device only."""
        self._watched = _LIBC.inotify_add_watch(self._inotify, device.encode(), _MODIFIED)

    def watch_connection(self, fd: int) -> None:
        """From now on return the arrivals on this connection only; until it is closed."""
        # The connection before may have had the same descriptor.
        self._watched, self._since = fd, time.monotonic()
        self._epoll.register(fd, select.EPOLLIN | select.EPOLLET)      # once for each arrival

    def next(self, seconds: float = 0.0) -> List[float]:
        """The times, by `time.monotonic`, that were noted since the last call; waits so long for
        one."""
        select.select([self._times], [], [], seconds)
        with contextlib.suppress(BlockingIOError):
            return [at for watch, at in _RECORD.iter_unpack(os.read(self._times, 1 << 16))
                    if watch == self._watched and at >= self._since]
        return []


def _note(inotify: int, epoll: int, pipe: int) -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    with contextlib.suppress(OSError):      # without the permission
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    os.set_blocking(pipe, False)
    events = select.epoll.fromfd(epoll)
    while True:
        found, now = events.poll(), time.monotonic()
        watched = [fd for fd, _event in found if fd != inotify]
        if len(watched) < len(found):
            watched += [watch for watch, kind, _cookie, _size in struct.iter_unpack(
                'iIII', os.read(inotify, 4096)) if kind == _MODIFIED]
        with contextlib.suppress(BlockingIOError):      # nobody reads, as from a frozen line
            os.write(pipe, b''.join(_RECORD.pack(watch, now) for watch in watched))


if __name__ == '__main__':
    _note(*map(int, sys.argv[1:]))
