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

PERIOD = 0.01       # s from one time to the next
LATE = 0.005        # s; less does not count
_KEPT = 10000       # times at which it was late
_RECORD = struct.Struct('dd')     # when it should have run, and when it had


class Witness:
    """Runs until `end`, or the end of its block.

    Args:
        priority: the real-time priority of the tested program; 0: it has none.
        processor: the only one that it uses, by number; negative: any.
        work: s of processor time that it uses each time; 0: it only sleeps.
        period: s from one time to the next.
    """

    def __init__(self, priority=0, processor=-1, work=0.0, period=PERIOD):
        self._work = work
        self._times, self._waited = 0, 0.0      # how often, and how long in all
        self._late = deque(maxlen=_KEPT)        # (from, until) of each time at which it was late
        self._noted = 0.0
        self._process = subprocess.Popen(
            [sys.executable, __file__, *map(str, (priority, processor, work, period))],
            stdout=subprocess.PIPE, start_new_session=True)
        self._thread = threading.Thread(target=self._read, name='witness', daemon=True)
        self._thread.start()
        wait_until(lambda: self._times or self._process.poll() is not None, 'the witness runs')

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.end()

    def end(self):
        """End the process; what it has noted is kept."""
        self._process.kill()
        self._process.wait()
        self._thread.join()

    def late(self, since, until):
        """For how many s it was late, each time that this was between these two times of
        time.monotonic() at least in part."""
        wait_until(lambda: self._noted > until or not self._thread.is_alive(),
                   'the witness has run since')
        return [end - begin for begin, end in list(self._late) if end > since and begin < until]

    @property
    def slowdown(self):
        """How many times longer its work takes than the processor time that it uses."""
        return 1.0 + self._waited / (self._work * self._times)

    def _read(self):
        with self._process.stdout as output:
            for record in iter(lambda: output.read(_RECORD.size), b''):
                due, done = _RECORD.unpack(record)
                waited = max(0.0, done - due - self._work)
                if waited > LATE:
                    self._late.append((due, done))
                self._waited += waited
                self._times += 1
                self._noted = done


def priority_of(pid):
    """The real-time priority of the thread of a process that has the highest; 0: none has one."""
    return max(os.sched_getparam(int(thread)).sched_priority
               for thread in os.listdir(f'/proc/{pid}/task'))


def _run(priority, processor, work, period):
    if processor >= 0:
        os.sched_setaffinity(0, {int(processor)})
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(priority)))
    due = done = time.monotonic()
    while True:
        due = max(due + period, done)       # so a wait for a processor in the lines below counts
        time.sleep(max(0.0, due - time.monotonic()))
        used = time.process_time()
        while time.process_time() < used + work:
            pass
        done = time.monotonic()
        os.write(1, _RECORD.pack(due, done))


if __name__ == '__main__':
    try:
        _run(*map(float, sys.argv[1:]))
    except BrokenPipeError:
        pass        # who started it has ended
