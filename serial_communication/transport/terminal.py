"""What a terminal may do to a program that serves a port."""
import signal


def write_in_background() -> None:
    """Go on as a background job that writes to its terminal, too.

    After `stty tostop` the kernel would stop the whole process, heartbeat included, at the first
    line of its log. To be called in the main thread.
    """
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
