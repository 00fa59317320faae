"""Logging that neither holds up nor fails who logs: every handler runs in a thread of its own.

rospy's handlers write to the terminal, to a file and to /rosout in the thread that has something
to say. A pipe that nobody reads makes that thread wait for ever, a closed one or a full disk
raises from the log call. Here a line is only queued; a handler that hangs or fails takes nothing
with it, not even the other handlers.
"""
import logging
import os
import queue
import sys
import threading
import time
from typing import Dict

_QUEUED = 1000    # lines that wait for one handler at most; newer ones are left out
_LAST = 0.5       # s for what still waits as the process ends

_handle = logging.Handler.handle
_writers: Dict[logging.Handler, '_Writer'] = {}
_lock = threading.Lock()


class _Writer:
    """The thread of one handler, and what waits for it."""

    def __init__(self, handler: logging.Handler) -> None:
        self._handler = handler
        self._queue: queue.SimpleQueue = queue.SimpleQueue()    # its put never waits
        self._left_out = 0
        self.thread = threading.Thread(target=self._run, name=f'log {type(handler).__name__}',
                                       daemon=True)
        self.thread.start()

    def put(self, record: logging.LogRecord) -> None:
        """Have it written, or leave it out where too many wait."""
        if self._queue.qsize() < _QUEUED:
            self._queue.put(record)
        else:
            self._left_out += 1

    def end(self) -> None:
        """Have the thread end when everything before this is written."""
        self._queue.put(None)

    def _run(self) -> None:
        for record in iter(self._queue.get, None):
            self._write(record)
            if self._left_out and self._queue.empty():
                count, self._left_out = self._left_out, 0
                self._write(logging.LogRecord(
                    'rosout', logging.WARNING, __file__, 0,
                    f'{count} lines of the log were left out: they could not be written', (), None))

    def _write(self, record: logging.LogRecord) -> None:
        try:
            _handle(self._handler, record)
        except Exception:  # pylint: disable=broad-except
            pass    # a log that cannot be written has nowhere to say so


def install() -> None:
    """From now on, for every handler of this process; call it before rospy makes its own."""
    logging.Handler.handle = _hand_over
    logging.raiseExceptions = False     # or logging itself tells of a failure on stderr


def _hand_over(handler: logging.Handler, record: logging.LogRecord) -> None:
    try:
        writer = _writers.get(handler)
        if writer is None:
            with _lock:
                writer = _writers.get(handler) or _Writer(handler)
                _writers[handler] = writer
        writer.put(record)
    except Exception:  # pylint: disable=broad-except
        pass    # no thread to be had, say: the line is lost, and who logged goes on


def finish() -> bool:
    """Write what still waits, as the process ends; at most half a second.

    Returns:
        Whether all is written. Otherwise the process has to end by os._exit: the interpreter, as
        it ends, would wait for a stream that is stuck for ever.
    """
    deadline = time.monotonic() + _LAST
    for writer in list(_writers.values()):
        writer.end()
    threads = [writer.thread for writer in list(_writers.values())]
    threads.append(threading.Thread(target=_flush, name='log flush', daemon=True))
    for thread in threads:
        if not thread.ident:
            thread.start()      # after the others: it writes what they left in the streams
        thread.join(max(0.0, deadline - time.monotonic()))
        if thread.is_alive():
            return False
    return True


def _flush() -> None:
    """Nothing is left in the standard streams; what they do not take is dropped."""
    for stream in sys.stdout, sys.stderr:
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        except (AttributeError, ValueError):
            pass    # None: it was closed before the start; or closed since
