"""How much slower other programs make this machine.

A promise in seconds is of a machine that has time. A witness is a process with the priority of the
tested program, in a session of its own, since Linux shares the processor among sessions. It does a
small piece of work again and again. If that takes longer than the processor time that it needs, the
tested program has to wait in the same way.
"""
import subprocess
import sys
import tempfile

_WORK = '''
import time
while True:
    began, used = time.monotonic(), time.process_time()
    while time.process_time() - used < 0.02:
        pass
    print(time.monotonic() - began, flush=True)
    time.sleep(0.08)
'''


class Witness:
    """Works until its block ends."""

    def __enter__(self):
        self._output = tempfile.TemporaryFile('w+')
        self._process = subprocess.Popen([sys.executable, '-c', _WORK], stdout=self._output,
                                         start_new_session=True)
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()
        self._output.seek(0)
        took = [float(line) for line in self._output if line.endswith('\n')]
        self._output.close()
        self.slowdown = sum(took) / (0.02 * len(took)) if took else 1.0     # 1: it never waited
