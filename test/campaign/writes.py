"""When programs write to devices, noted by a process of its own, which no thread here delays.

The kernel moves the bytes of pseudo terminals in a thread of ordinary priority, so on a busy
machine they are read late, by up to 0.5 s. But it tells at once (inotify) when a program has
written to the device. As a program (arguments: descriptors of inotify and of a pipe) it is that
process.
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
_RECORD = struct.Struct('qd')     # of which device, and when


class Writes:
    """Notes when programs write to a device."""

    def __init__(self) -> None:
        self._inotify, self._watched = _LIBC.inotify_init1(0), 0
        self._times, end = os.pipe()
        os.set_blocking(self._times, False)
        self._process = subprocess.Popen(       # Ctrl-C does not reach it
            [sys.executable, '-IS', __file__, str(self._inotify), str(end)],
            pass_fds=(self._inotify, end), start_new_session=True)
        os.close(end)

    def watch(self, device: str) -> None:
        """From now on return the writes to this device only."""
        self._watched = _LIBC.inotify_add_watch(self._inotify, device.encode(), _MODIFIED)

    def next(self, seconds: float = 0.0) -> List[float]:
        """The times, by `time.monotonic`, that were noted since the last call; waits so long for
        one."""
        select.select([self._times], [], [], seconds)
        with contextlib.suppress(BlockingIOError):
            return [at for watch, at in _RECORD.iter_unpack(os.read(self._times, 1 << 16))
                    if watch == self._watched]
        return []


def _note(inotify: int, pipe: int) -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    with contextlib.suppress(OSError):      # without the permission
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    os.set_blocking(pipe, False)
    while True:
        events, now = os.read(inotify, 4096), time.monotonic()
        records = [_RECORD.pack(watch, now) for watch, kind, _cookie, _size in struct.iter_unpack(
            'iIII', events) if kind == _MODIFIED]
        with contextlib.suppress(BlockingIOError):      # nobody reads, as from a frozen line
            os.write(pipe, b''.join(records))


if __name__ == '__main__':
    _note(*map(int, sys.argv[1:]))
