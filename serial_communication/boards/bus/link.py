"""The link to the control board: its callers wait for the outcome."""
from typing import Optional

from ...link.link import Link
from ...link.outcome import TIMEOUT, Outcome
from ...link.session import Refused
from . import wire
from .call import UNKNOWN, Call, OnSuccess
from .session import MasterSession


class BusLink(Link):
    """Takes requests from any thread. Each gets an outcome, whatever happens to the port."""

    session: MasterSession

    def request(self, request: wire.Request, function: wire.Function = wire.RAW,
                on_success: Optional[OnSuccess] = None) -> Outcome:
        """Send any request and wait for its outcome, which always comes: see `submit`."""
        call = self.submit(request, function, on_success)
        turn = self.session.queue.longest_wait + call.timeout
        if not call.over.wait((1 + self.session.options.retries) * turn):
            call.finish(Outcome(TIMEOUT, f'the bridge is stuck: {UNKNOWN}'))    # it is dropped
        assert call.outcome
        return call.outcome

    def submit(self, request: wire.Request, function: wire.Function = wire.RAW,
               on_success: Optional[OnSuccess] = None) -> Call:
        """Have a request sent, and return the call, which gets its outcome; `on_success` is called
        in the link's thread."""
        call = self.session.options.call(request, function, self.now(), on_success)
        try:
            wire.encode_request(request)        # ValueError: its data are too long
            self.writer.submit(call)
        except (Refused, ValueError) as error:
            call.finish(call.without_reply(str(error)))
        return call
