"""Logs that hold nothing up: each handler of rospy's loggers writes in a thread of its own.

A terminal or a pipe that nobody reads blocks who writes to it, and a closed one, or a full disk,
raises. Here a log call only queues its line.
"""
import logging
import os
import queue
import sys
from contextlib import suppress
from logging.handlers import QueueHandler, QueueListener
from typing import List

from ..link.sparing_log import SparingLog

LOGGER = logging.getLogger('rosout')    # rospy's, for terminal, file and /rosout
_QUEUED = 1000    # lines that may wait for one handler; newer ones are dropped


class _Input(QueueHandler):
    """Queues lines for one handler. The next one after those that it drops has their number."""

    dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        if self.queue.qsize() >= _QUEUED:
            self.dropped += 1
            return
        if self.dropped:
            record.msg = f'{record.msg} ({self.dropped} log lines before this one were dropped)'
            self.dropped = 0
        self.queue.put(record)


class _Writer(QueueListener):
    def handle(self, record: logging.LogRecord) -> None:
        with suppress(Exception):     # there is no other log to report it to
            super().handle(record)


_writers: List[_Writer] = []


def sparing_log(name: str) -> SparingLog:
    """Return a log of a link or another part."""
    return SparingLog(name, LOGGER)


def queue_lines() -> None:
    """Have the handlers of rospy's loggers write in threads; call this after rospy.init_node."""
    logging.raiseExceptions = False     # otherwise logging reports failures on stderr
    for logger in logging.getLogger(), LOGGER:
        for handler in list(logger.handlers):
            waiting = _Input(queue.SimpleQueue())   # a handler of a signal may log inside its `put`
            _writers.append(_Writer(waiting.queue, handler))
            _writers[-1].start()
            logger.removeHandler(handler)
            logger.addHandler(waiting)


def finish(status: int) -> None:
    """Write the waiting lines when the process ends; a stream that is blocked blocks this.

    If one is closed, end the process with this status: the interpreter's own exit would fail.
    """
    try:
        for writer in _writers:
            writer.stop()
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
    except (OSError, ValueError):
        os._exit(status)
