"""The main control board as the tests play it, on whatever line a test gives it.

It is not that of the simulation: it is as simple as can be, so that a test shows all that it does.
"""
from collections import deque

from serial_communication.boards.bus import wire as bus

AIR = bus.Environment(350, 25.63, 48.12)


class FakeBus:
    """Answers SYNC and ECHO and obeys, or does as it is told.

    To be inherited from beside a class that has the line: it calls `take` with each valid frame
    of a `RequestDecoder`, and its `write` puts bytes on the line.

    `rule` is asked first, with each request; then, for what is neither SYNC nor ECHO, `script`
    holds what the next ones get. Both give a Reply, or bytes, of which b'' is no answer at all;
    None is the usual answer. In `script` a function of the request may stand for one of these.
    """

    def __init__(self, has_cmd2=False, polled=False):
        self.rule = lambda request: None
        self.script = deque()
        self.air = AIR
        self.executed = []           # the functions that it has carried out: it has all of them
        self._has_cmd2 = has_cmd2
        self._polled = polled        # then the environment is none of the script's

    def take(self, frame):
        """A valid frame has come."""
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
        """Do what is asked; the Reply to it."""
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
