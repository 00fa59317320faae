"""Logging that neither blocks nor raises: every handler runs in a separate thread.

rospy's handlers write to the terminal, to a file and to /rosout in the thread that logs. A pipe
that nobody reads blocks that thread for ever; a closed pipe or a full disk raises from the log
call. Here the log call only queues the line, and a handler that hangs or fails affects nothing
else, not even the other handlers.
"""
import logging
import queue
import sys
import threading
import time
from typing import Dict, Optional

from ...output import no_more_output

_QUEUED = 1000    # lines that may wait for one handler; newer ones are dropped
_LAST = 0.5       # s to write the waiting lines when the process ends

_handle = logging.Handler.handle
_writers: Dict[logging.Handler, '_Writer'] = {}
_lock = threading.Lock()


class _Writer:
    """The thread of one handler, with its queue."""

    def __init__(self, handler: logging.Handler) -> None:
        self._handler = handler
        # put() never blocks; None ends the thread.
        self._queue: 'queue.SimpleQueue[Optional[logging.LogRecord]]' = queue.SimpleQueue()
        self._dropped = 0
        self.thread = threading.Thread(target=self._run, name=f'log {type(handler).__name__}',
                                       daemon=True)
        self.thread.start()

    def put(self, record: logging.LogRecord) -> None:
        """Queue a record; drop it if too many are waiting."""
        if self._queue.qsize() < _QUEUED:
            self._queue.put(record)
        else:
            self._dropped += 1

    def end(self) -> None:
        """End the thread after it has written everything that is queued."""
        self._queue.put(None)

    def _run(self) -> None:
        for record in iter(self._queue.get, None):
            self._write(record)
            if self._dropped and self._queue.empty():
                count, self._dropped = self._dropped, 0
                self._write(logging.LogRecord(
                    'rosout', logging.WARNING, __file__, 0,
                    f'{count} log lines were dropped: the log could not be written', (), None))

    def _write(self, record: logging.LogRecord) -> None:
        try:
            _handle(self._handler, record)
        except Exception:  # pylint: disable=broad-except
            pass    # there is no other log to report this to


def install() -> None:
    """Patch all handlers of this process; call this before rospy creates its handlers."""
    logging.Handler.handle = _enqueue   # type: ignore[assignment]  # it replaces a method
    logging.raiseExceptions = False     # otherwise logging reports failures on stderr


def _enqueue(handler: logging.Handler, record: logging.LogRecord) -> None:
    try:
        writer = _writers.get(handler)
        if writer is None:
            with _lock:
                writer = _writers.get(handler) or _Writer(handler)
                _writers[handler] = writer
        writer.put(record)
    except Exception:  # pylint: disable=broad-except
        pass    # the thread may fail to start; the line is lost, but the caller continues


def finish() -> bool:
    """Write the waiting lines when the process ends; takes 0.5 s at most.

    Returns:
        Whether all were written. If not, end the process with os._exit: the interpreter's own exit
        would wait for ever for the blocked stream.
    """
    deadline = time.monotonic() + _LAST
    for writer in list(_writers.values()):
        writer.end()
    threads = [writer.thread for writer in list(_writers.values())]
    threads.append(threading.Thread(target=_flush, name='log flush', daemon=True))
    for thread in threads:
        if not thread.ident:
            thread.start()      # last, since it writes what the others left in the streams
        thread.join(max(0.0, deadline - time.monotonic()))
        if thread.is_alive():
            return False
    return True


def _flush() -> None:
    """Flush the standard streams; drop what they do not take."""
    for stream in sys.stdout, sys.stderr:
        try:
            stream.flush()
        except OSError:
            no_more_output(stream.fileno())
        except (AttributeError, ValueError):
            pass    # the stream is None (closed before the start), or has been closed
