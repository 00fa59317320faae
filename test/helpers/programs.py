"""Starts programs for a test, ends them with it, and finds what is left of them."""
import contextlib
import os
import random
import socket
import tempfile


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
