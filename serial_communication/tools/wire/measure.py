"""What a tap adds to a line, in ms: the same bytes through it and, in turns, past it."""
import json
import os
import pty
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from typing import Dict, List

from ...boards.arduino import wire as arduino
from ...transport.pace import be_quick
from .figures import percentile

_FRAME = arduino.encode(arduino.Heartbeat())
_PERIOD = 0.01             # s from one frame to the next
_REALTIME_PRIORITY = 10
_START = 10.0              # s for the tap to start in


class _Pair:
    """A pseudo terminal: a device with a path, and the end that we hold."""

    def __init__(self) -> None:
        self.fd, self._device = pty.openpty()
        tty.setraw(self._device)
        self.path = os.ttyname(self._device)

    def open_device(self) -> int:
        """The device itself, for the way past the tap."""
        return os.open(self.path, os.O_RDWR | os.O_NOCTTY)


def run(link: str, duration: float, as_json: bool) -> int:
    """Measure and print; the exit status."""
    board, computer, direct = _Pair(), _Pair(), _Pair()
    device = direct.open_device()
    # In a process of its own, like any tap; it prints to a file that nobody waits for.
    with tempfile.TemporaryFile() as output:
        tap = subprocess.Popen(
            [sys.executable, '-m', 'serial_communication.tools.wire', 'tap', link, board.path,
             computer.path], stdout=output, stderr=output,
            env=dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path)))
        try:
            if not _passes(computer.fd, board.fd):
                output.seek(0)
                print(f'the tap does not pass anything on: {output.read().decode()}',
                      file=sys.stderr)
                return 1
            times: Dict[str, List[float]] = {}
            thread = threading.Thread(target=_exchange, name='measuring', args=(
                times, duration, {'to the board': (computer.fd, board.fd),
                                  'from the board': (board.fd, computer.fd),
                                  'no tap': (direct.fd, device)}))
            thread.start()
            thread.join()
        finally:
            tap.terminate()
            tap.wait()
    _report(times, as_json)
    return 0


def _passes(source: int, sink: int) -> bool:
    deadline = time.monotonic() + _START
    while time.monotonic() < deadline:
        os.write(source, _FRAME)
        if select.select([sink], [], [], 0.1)[0]:
            while select.select([sink], [], [], 0.2)[0]:
                os.read(sink, 4096)
            return True
    return False


def _exchange(times: Dict[str, List[float]], duration: float, ways: Dict[str, tuple]) -> None:
    be_quick(_REALTIME_PRIORITY)
    end = time.monotonic() + duration
    due = time.monotonic()
    while time.monotonic() < end:
        for name, (source, sink) in ways.items():
            due += _PERIOD
            time.sleep(max(due - time.monotonic(), 0.0))
            sent = time.monotonic()
            os.write(source, _FRAME)
            if select.select([sink], [], [], 1.0)[0]:
                os.read(sink, 4096)
                times.setdefault(name, []).append(time.monotonic() - sent)


def _report(times: Dict[str, List[float]], as_json: bool) -> None:
    figures = {name: {'count': len(values), 'p50': percentile(values, 50) * 1e3,
                      'p99': percentile(values, 99) * 1e3, 'max': max(values) * 1e3}
               for name, values in times.items()}
    base = figures['no tap']['p50']
    added = {name: each['p50'] - base for name, each in figures.items() if name != 'no tap'}
    if as_json:
        print(json.dumps({'milliseconds': figures, 'added at the median': added}))
        return
    for name, each in figures.items():
        print(f'{name:15} {each["count"]:6} frames   p50 {each["p50"]:.3f}   '
              f'p99 {each["p99"]:.3f}   max {each["max"]:.3f} ms')
    for name, value in added.items():
        print(f'added {name}: {value:.3f} ms at the median')
