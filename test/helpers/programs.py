"""Starts programs for a test, and ends them with it."""


def started(make):
    """For a fixture: yields a function that starts a program by `make`.

    `make` returns an object with a `process`, which is killed when the test ends.
    """
    begun = []

    def begin(*arguments):
        begun.append(make(*arguments))
        return begun[-1]

    yield begin
    for one in begun:
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait()
