"""Starts programs for a test, and ends them with it."""
import contextlib
import os
import random
import re
import signal
import socket
import subprocess
import tempfile

from waiting import PATIENCE, until


class Output:
    """A temporary file into which programs print.

    They and this process share the place in the file at which the next read or write happens. So
    what they have printed is read without it: else a line that is printed meanwhile overwrites
    another one.
    """

    def __init__(self):
        self._file = tempfile.TemporaryFile()

    def fileno(self):
        return self._file.fileno()

    def close(self):
        self._file.close()

    def text(self):
        """What they have printed so far."""
        size = os.fstat(self.fileno()).st_size
        return os.pread(self.fileno(), size, 0).decode(errors='replace')


class Process:
    """A running program.

    Args:
        stdout: where it prints; by default what `output` returns.
        environment: variables to set.
    """

    def __init__(self, *command, stdout=None, **environment):
        self._output = Output()
        self.process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=self._output if stdout is None else stdout,
            stderr=subprocess.STDOUT, env={**os.environ, **environment})

    @property
    def alive(self):
        """Whether it runs."""
        return self.process.poll() is None

    def output(self):
        """Its output so far, without colours."""
        return re.sub('\033\\[[0-9;]*m', '', self._output.text())

    def wait_for(self, words):
        """Wait until it has printed these words, and return the first line with them."""
        try:
            until(lambda: words in self.output() or not self.alive, f'it prints "{words}"',
                  every=0.05)
            return next(line for line in self.output().split('\n') if words in line)
        except (AssertionError, StopIteration):
            raise AssertionError(f'it does not print "{words}", but: {self.output()}') from None

    def ended(self):
        """Wait until it ends by itself; return its exit status."""
        return self.process.wait(PATIENCE)

    def end(self, number=signal.SIGINT):
        """Send a signal, if it runs; return its exit status."""
        self.process.send_signal(number)
        return self.ended()

    def kill(self):
        """Kill it, if it runs."""
        self.process.kill()
        self.process.wait(PATIENCE)


def started(make):
    """For a fixture: yields a function that starts a program by `make`.

    `make` returns an object with a `process`, which is killed when the test ends.
    """
    begun = []

    def begin(*arguments, **options):
        begun.append(make(*arguments, **options))
        return begun[-1]

    yield begin
    for one in begun:
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait()


def free_master():
    """The address of a master that is not there yet.

    Its port is below those from which Linux takes the ports of outgoing connections (32768 …), so
    that no other program's connection gets it before the master starts, or while it is away.
    """
    for port in random.sample(range(20000, 32000), 100):
        with socket.socket() as free, contextlib.suppress(OSError):
            free.bind(('', port))
            return f'http://localhost:{port}'
    raise OSError('no port is free')
