"""Waits for conditions and blocking calls, with a deadline."""
import threading
import time

# s that a condition without a time of its own may take: only a failing test waits as long. Starting
# a program takes over 15 s where each processor has ten others.
PATIENCE = 60.0


def until(condition, what='the condition', seconds=PATIENCE, doing=None, every=0.01):
    """Wait until `condition()` is true, and return its value; AssertionError after `seconds`.

    The condition is checked every `every` s; `doing` is called before each check.
    """
    deadline = time.monotonic() + seconds
    while True:
        if doing:
            doing()
        value = condition()
        if value:
            return value
        if time.monotonic() > deadline:
            raise AssertionError(f'not within {seconds:g} s: {what}')
        time.sleep(every)


def again_if_stalled(attempt, tries=5):
    """Return the first true result of `attempt()`, which a stall of this machine may spoil.

    AssertionError if all of so many tries in a row are without one: a stall is no excuse for that.
    """
    for _ in range(tries):
        result = attempt()
        if result:
            return result
    raise AssertionError(f'failed {tries} times in a row: {attempt.__name__}')


def all_of(read, size):
    """So many bytes, in as many reads as that takes; fewer after `PATIENCE` s."""
    data, deadline = b'', time.monotonic() + PATIENCE
    while len(data) < size and time.monotonic() < deadline:
        data += read(0.1)
    return data


class Waiter(threading.Thread):
    """Runs a blocking call in a thread, so that the test can act meanwhile."""

    def __init__(self, function, *arguments):
        super().__init__(daemon=True)
        self.answer = None
        self.error = None
        self.took = 0.0
        self._call = lambda: function(*arguments)
        self.start()

    def run(self):
        began = time.monotonic()
        try:
            self.answer = self._call()
        except Exception as error:  # pylint: disable=broad-except
            self.error = error
        self.took = time.monotonic() - began

    def result(self, seconds=PATIENCE):
        """Wait for the call; return its result, or raise its exception."""
        self.join(seconds)
        assert not self.is_alive(), f'the call has not returned within {seconds:g} s'
        if self.error:
            raise self.error
        return self.answer
