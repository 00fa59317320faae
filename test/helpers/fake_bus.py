"""A main control board for tests, on any line.

It is much simpler than the simulated one, so that a test shows all that it does.
"""
from collections import deque

from serial_communication.boards.bus import wire as bus

AIR = bus.Environment(350, 25.63, 48.12)


def lift(direction, distance):
    """A move of the lift."""
    return bus.LIFT_FUNCTION.make_request((direction, distance))


def gimbal(direction, angle):
    """A turn of the gimbal."""
    return bus.GIMBAL_FUNCTION.make_request((direction, angle))


class FakeBus:
    """Answers every request as usual, or as `rule` and `script` say.

    A mixin: the other base class has the line. It calls `take` with each valid frame of a
    `RequestDecoder`, and has `write`, which writes bytes to the line.

    `rule` is called first, with each request. Requests other than SYNC and ECHO then take the next
    element of `script`. Either gives a Reply, bytes (b'': no answer), or None (the usual answer).
    An element of `script` may be a function that gets the request and returns one of these.

    Args:
        rule: the initial one.
        has_cmd2: replies have CMD2.
        polled: requests for the environment take nothing from `script`.
    """

    def __init__(self, has_cmd2=False, polled=False, rule=lambda request: None):
        self.rule = rule
        self.script = deque()
        self.air = AIR
        self.executed = []           # the executed function requests; every function exists
        self._has_cmd2 = has_cmd2
        self._polled = polled

    def take(self, frame):
        """Answer a valid frame."""
        request = frame.message
        answer = self.rule(request)
        if answer is None and self.script and self._is_scripted(request):
            answer = self.script.popleft()
            if callable(answer):
                answer = answer(request)
        self.say(self.usual(request) if answer is None else answer)

    def say(self, answer):
        """Send a Reply, or bytes."""
        if isinstance(answer, bus.Reply):
            answer = bus.encode_reply(answer, self._has_cmd2)
        if answer:
            self.write(answer)

    def usual(self, request):
        """Execute a request; return the usual Reply."""
        if request.cmd1 in (bus.SYNC, bus.ECHO):
            return bus.Reply(request.cmd1, request.data, request.cmd2)
        if request.cmd1 != bus.FUNCTION:
            return bus.Reply(bus.ERROR, bus.UNSUPPORTED.to_bytes(2, 'little'), request.cmd2)
        self.executed.append(request)
        data = self.air.pack() if request == bus.ENVIRONMENT_REQUEST else b''
        return bus.Reply(bus.OK, data, request.cmd2)

    def _is_scripted(self, request):
        return request.cmd1 not in (bus.SYNC, bus.ECHO) \
            and not (self._polled and request == bus.ENVIRONMENT_REQUEST)
