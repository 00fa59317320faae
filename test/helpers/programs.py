"""Programs that a test starts."""


def started(make):
    """For a fixture: a function that starts one as `make` does, whose `process` ends with the
    test."""
    begun = []

    def begin(*arguments):
        begun.append(make(*arguments))
        return begun[-1]

    yield begin
    for one in begun:
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait()
