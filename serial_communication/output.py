"""What a program prints: standard output and standard error."""
import io
import signal
import sys


def prepare_output() -> None:
    """To be called first of all in a program, by its main thread.

    A printed line then arrives at once, in a file or a pipe as on a terminal. Otherwise Python
    keeps up to 8 KB of stdout back where it is no terminal, and before 3.9 of stderr, too. And a
    background job goes on as it writes to its terminal: after `stty tostop` the kernel would stop
    the whole process, heartbeat included, at the first line of its log.
    """
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    for stream in sys.stdout, sys.stderr:
        if isinstance(stream, io.TextIOWrapper):    # None: it was closed before the start
            stream.reconfigure(line_buffering=True)
