"""Runs a program in a pseudo terminal of any size."""
import fcntl
import os
import pty
import re
import signal
import struct
import termios
import threading
import time

from waiting import PATIENCE


class Terminal:
    """Runs a command in a pseudo terminal, in its own session.

    Args:
        command: the program and its arguments.
        columns, rows: the initial size.
        environment: variables to set.
    """

    def __init__(self, command, columns=80, rows=24, **environment):
        self._output = bytearray()
        self._ended = threading.Event()
        self.status = None
        begun, begins = os.pipe()       # closed by the kernel when the program begins
        self.pid, self._far = pty.fork()
        if self.pid == 0:
            try:
                os.environ.update(environment)
                self._set_size(1, columns, rows)
                os.execv(str(command[0]), [str(each) for each in command])
            finally:
                os._exit(127)
        os.close(begins)
        os.read(begun, 1)       # before that a Ctrl-C would be lost in the forked Python
        os.close(begun)
        threading.Thread(target=self._read, daemon=True).start()

    @staticmethod
    def _set_size(terminal, columns, rows):
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack('HHHH', rows, columns, 0, 0))

    def _read(self):
        while True:
            try:
                data = os.read(self._far, 65536)
            except OSError:
                data = b''
            if not data:
                break
            self._output += data
        self.status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1]) \
            if hasattr(os, 'waitstatus_to_exitcode') else os.waitpid(self.pid, 0)[1] >> 8
        self._ended.set()

    def text(self):
        """Return all output so far, without colours."""
        return re.sub('\033\\[[0-9;?]*[A-Za-z]', '', self._output.decode(errors='replace'))

    def until(self, condition, what):
        """Wait until `condition()` is true, and return its value."""
        deadline = time.monotonic() + PATIENCE
        while True:
            value = condition()
            if value:
                return value
            assert time.monotonic() < deadline, f'not within {PATIENCE:g} s: {what}\n{self.text()}'
            assert not self._ended.is_set(), f'ended before: {what}\n{self.text()}'
            time.sleep(0.01)

    def close(self):
        """End the program if it still runs, after a failed test."""
        if not self._ended.is_set():
            os.kill(self.pid, signal.SIGTERM)
            if not self._ended.wait(PATIENCE):
                os.kill(self.pid, signal.SIGKILL)
                self._ended.wait(PATIENCE)
        os.close(self._far)
