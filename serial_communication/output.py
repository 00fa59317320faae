"""Standard output and standard error of a program."""
import io
import os
import signal
import sys


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
