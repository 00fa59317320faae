"""Standard output and standard error of a program."""
import io
import os
import signal
import sys
from typing import Callable

_SIGPIPE_STATUS = 128 + signal.SIGPIPE     # as a shell reports a program that SIGPIPE has ended


def prepare_output() -> None:
    """Write each printed line at once, and never be stopped by a terminal.

    The main thread of a program calls this first. Without it Python buffers up to 8 KB of stdout,
    and before 3.9 of stderr, unless they are a terminal. And after `stty tostop` the kernel stops
    a background job, heartbeat included, when it prints its first line.
    """
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    for stream in sys.stdout, sys.stderr:
        if isinstance(stream, io.TextIOWrapper):    # None if it was closed before the start
            stream.reconfigure(line_buffering=True)


def no_more_output(descriptor: int = 1) -> None:
    """Redirect an output that cannot be written to, or flushing it at exit would fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)


def end_with_output(run: Callable[[], int]) -> int:
    """Run a program, and return its exit status. If the reader of its output has ended, it ends
    without a word."""
    try:
        return run()
    except BrokenPipeError:
        no_more_output()
        return _SIGPIPE_STATUS
