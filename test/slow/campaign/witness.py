"""Whether this machine gave a program its time, measured by a process that does nothing else.

A promise in seconds is of a machine that has time. A witness is a process with the policy and the
priority of the tested program, in a session of its own, since Linux shares the processors among
sessions. It sleeps until a time, again and again. How much later than that it runs, by
CLOCK_MONOTONIC, is how long the tested program may have waited for a processor.
"""
import os
import struct
import subprocess
import sys
import threading
import time
from collections import deque

from waiting import until as wait_until

LATE = 0.005        # s; less does not count
_KEPT = 10000       # times at which it was late
_RECORD = struct.Struct('dd')     # when it should have run, and when it had


class Witness:
    """Runs until `end`.

    Args:
        priority: the real-time priority of the tested program; 0: it has none.
        processor: the only one that it uses, by number; negative: any.
        period: s from one time to the next.
    """

    def __init__(self, priority, processor, period):
        self._late = deque(maxlen=_KEPT)        # (from, until) of each time at which it was late
        self._noted = 0.0
        self._process = subprocess.Popen(
            [sys.executable, __file__, *map(str, (priority, processor, period))],
            stdout=subprocess.PIPE, start_new_session=True)
        self._thread = threading.Thread(target=self._read, name='witness', daemon=True)
        self._thread.start()

    def end(self):
        """End the process; what it has noted is kept."""
        self._process.kill()
        self._process.wait()
        self._thread.join()

    def late(self, since, until):
        """For how many s it was late, each time that this was between these two times of
        time.monotonic() at least in part. Waits until it has run after `until`."""
        wait_until(lambda: self._noted > until or not self._thread.is_alive(),
                   'the witness has run since')
        return [end - begin for begin, end in list(self._late) if end > since and begin < until]

    def _read(self):
        with self._process.stdout as output:
            for record in iter(lambda: output.read(_RECORD.size), b''):
                due, done = _RECORD.unpack(record)
                if done - due > LATE:
                    self._late.append((due, done))
                self._noted = done


def _run(priority, processor, period):
    if processor >= 0:
        os.sched_setaffinity(0, {int(processor)})
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(priority)))
    due = done = time.monotonic()
    while True:
        due = max(due + period, done)       # so a wait for a processor in the lines below counts
        time.sleep(max(0.0, due - time.monotonic()))
        done = time.monotonic()
        os.write(1, _RECORD.pack(due, done))


if __name__ == '__main__':
    try:
        _run(*map(float, sys.argv[1:]))
    except BrokenPipeError:
        pass        # who started it has ended
