"""Logs that hold nothing up: each handler of rospy's loggers writes in a thread of its own.

A terminal or a pipe that nobody reads blocks who writes to it, and a closed one, or a full disk,
raises. Here a log call only queues its line.
"""
import logging
import queue
import sys
import threading
from logging.handlers import QueueHandler, QueueListener
from typing import List

from ..output import no_more_output

_QUEUED = 1000    # lines that may wait for one handler; newer ones are dropped
_LAST = 0.5       # s to write the waiting lines when the process ends

_writers: List['_Writer'] = []


class _Input(QueueHandler):
    """Queues lines for one handler, and counts those that it drops."""

    def __init__(self) -> None:
        super().__init__(queue.SimpleQueue())    # a handler of a signal may log inside its `put`
        self.dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        if self.queue.qsize() < _QUEUED:
            self.queue.put(record)
        else:
            self.dropped += 1


class _Writer(QueueListener):
    """The thread of one handler."""

    def __init__(self, handler: logging.Handler) -> None:
        self.input = _Input()
        super().__init__(self.input.queue, handler)

    def handle(self, record: logging.LogRecord) -> None:
        self._write(record)
        count = self.input.dropped
        if count and self.queue.empty():
            self.input.dropped -= count
            self._write(logging.LogRecord(
                'rosout', logging.WARNING, __file__, 0,
                f'{count} log lines were dropped: the log could not be written', (), None))

    def _write(self, record: logging.LogRecord) -> None:
        try:
            super().handle(record)
        except Exception:  # pylint: disable=broad-except
            pass    # there is no other log to report this to


def queue_lines() -> None:
    """Have the handlers of rospy's loggers write in threads; call this after rospy.init_node."""
    logging.raiseExceptions = False     # otherwise logging reports failures on stderr
    for logger in logging.getLogger(), logging.getLogger('rosout'):
        for handler in list(logger.handlers):
            writer = _Writer(handler)
            writer.start()
            _writers.append(writer)
            logger.removeHandler(handler)
            logger.addHandler(writer.input)


def finish() -> bool:
    """Write the waiting lines when the process ends; takes 0.5 s at most.

    Returns:
        Whether all were written. If not, end the process with os._exit: the interpreter's own exit
        would wait for ever for the blocked stream.
    """
    ending = threading.Thread(target=_finish, name='log flush', daemon=True)
    ending.start()
    ending.join(_LAST)
    return not ending.is_alive()


def _finish() -> None:
    while _writers:
        _writers.pop().stop()
    for stream in sys.stdout, sys.stderr:
        try:
            stream.flush()
        except OSError:
            no_more_output(stream.fileno())
        except (AttributeError, ValueError):
            pass    # the stream is None (closed before the start), or has been closed
