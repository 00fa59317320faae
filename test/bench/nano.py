"""Measures stamps of the emulated Nano; a child of the bench. A link here reads the board's port.

The emulator runs a slice of 1 ms, writes what was sent in it, and waits until the slice is over. So
even its plain line delivers in batches, of 1 ms.
"""
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Dict, List

from lines import Pty
from waiting import until
from serial_communication.boards.arduino import wire
from links import ArduinoLink
from serial_communication.framing.board_time import WINDOW
from serial_communication.transport.port import Port
from .child import serve, sleep_until

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'firmware'))
from emulated_board import Channel, Emulator, build_firmware  # noqa: E402

_LEARN = WINDOW     # s; then the line has all the points that it uses


class Adapter:
    """Delivers what the board sends every `batch` s; drops what the computer sends."""

    def __init__(self, board: str, path: str, batch: float) -> None:
        self._line = Pty(path).plug()
        self._board = os.open(board, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        self._batch = batch
        self._is_ended = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._is_ended:
            sleep_until((time.monotonic() // self._batch + 1) * self._batch)
            try:
                self._line.write(os.read(self._board, 4096))
            except BlockingIOError:
                pass
            self._line.read()

    def close(self) -> None:
        """End it; its port is gone."""
        self._is_ended = True
        self._thread.join()
        os.close(self._board)
        self._line.unplug()


def measure(build: str, seconds: float, batch: float) -> Dict[str, List[float]]:
    """Return the error of each stamp in s, of those of the reads, and of the distance of each two
    stamps; none if the emulator stalled, which stops the board's clock.

    Args:
        batch: s; an adapter delivers at each multiple of it. 0.0: there is no adapter.
    """
    times: list = []       # (board's time, stamp of the read) of each TIME
    found: list = []       # the same, and the stamp, of each TICKS
    emulator = Emulator(build, 'car', None, '--still')
    board = Channel(emulator.control)
    with tempfile.TemporaryDirectory() as folder:
        adapter = Adapter(emulator.port, folder + '/adapter', batch) if batch else None

        def on_message(message: Any, stamp: float) -> None:
            if isinstance(message, wire.Ticks) and times:
                found.append((*times[-1], stamp))

        def tap(_link: str, _direction: int, frame: Any) -> None:
            if frame.type == wire.Time.TYPE:
                times.append((frame.ticks, frame.stamp))

        link = ArduinoLink(Port(f'{folder}/adapter' if adapter else emulator.port),
                           clock=time.monotonic, on_message=on_message)
        link.session.tap = tap
        origin = board.ask('get origin')
        link.start()
        try:
            until(lambda: len(found) >= (_LEARN + seconds) * 100, 'the car has sent', 90)
            has_stalled = board.ask('get origin') != origin
        finally:
            link.stop()
            link.join()
            if adapter:
                adapter.close()
            board.close()
            emulator.close()
        if has_stalled:
            return {'read': [], 'board': [], 'distance': []}
    found = [(float(origin) + ticks * 1e-6, *stamps) for ticks, *stamps in found]
    stamps = [stamp - at for at, _, stamp in found[round(_LEARN * 100):]]
    return {'read': [abs(read - at) for at, read, _ in found[round(_LEARN * 100):]],
            'board': [abs(error) for error in stamps],
            'distance': [abs(after - before) for before, after in zip(stamps, stamps[1:])]}


def main() -> None:
    """Take the order `measure`."""
    build = build_firmware()
    serve(measure=lambda **options: measure(build, **options))


if __name__ == '__main__':
    main()
