"""What a program prints: standard output and standard error."""
import io
import sys


def print_line_by_line() -> None:
    """From now on a printed line arrives at once, in a file or a pipe as on a terminal.

    Without this Python keeps up to 8 KB of stdout back where it is no terminal, and before 3.9
    of stderr, too. To be called first of all in a program.
    """
    for stream in sys.stdout, sys.stderr:
        if isinstance(stream, io.TextIOWrapper):    # None: it was closed before the start
            stream.reconfigure(line_buffering=True)
