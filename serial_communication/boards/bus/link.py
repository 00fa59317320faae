"""The link to the control board: sends polls, and requests of callers, who wait for the outcome."""
import os
from typing import Any, Callable, List, Optional, Tuple

from ...framing.stream import IMPLAUSIBLE, LENGTH, Frame
from ...link.link import Link
from ...link.outcome import STOPPED, TIMEOUT, Outcome
from ...link.session import Condition, Packet, Refused, Session
from ...link.sparing_log import SparingLog
from . import wire
from .call import UNKNOWN, Call, OnSuccess
from .master import Master, MasterOptions
from .polls import AnnouncementReader, Polls
from .session import NO_SYNC, READY

_NOT_ANNOUNCED = 'the board may have begun anew, and has not announced this function since'


class MasterSession(Session):
    """The Master's session as a link drives it.

    Args:
        nonce: returns new bytes for an ECHO.
    """

    NAME = 'bus'
    FENCED = True      # the Master drops all replies until its ECHO or SYNC is answered

    def __init__(self, log: SparingLog, options: MasterOptions = MasterOptions(),
                 nonce: Callable[[], bytes] = lambda: os.urandom(4)) -> None:
        super().__init__(wire.ReplyDecoder(options.reply_has_cmd2), log)
        self.master = Master(options, log, nonce, self._refuses, self._begun_anew)
        self.polls = Polls(self._poll)
        # Requests of functions that interrupt, which ~stop calls.
        self.stops: List[Tuple[wire.Request, wire.Function]] = []
        self.options = options
        self._reader: Optional[AnnouncementReader] = None

    # -- for the Master -----------------------------------------------------------------

    def _refuses(self, function: wire.Function) -> str:
        if self.is_stopped and not function.repeatable:
            return STOPPED
        is_missing = function.announced and not self.announcement.is_current    # rule 12
        return _NOT_ANNOUNCED if is_missing else ''

    def _begun_anew(self, now: float) -> None:
        self.announcement.reset()
        if self._reader:
            self._reader.begin(now)

    def _poll(self, request: wire.Request, function: wire.Function, now: float,
              on_success: Optional[OnSuccess]) -> Call:
        call = self.master.make(request, function, now, on_success, is_poll=True)
        self.master.submit(call, now)
        return call

    # -- what happens -------------------------------------------------------------------

    def begin(self, now: float, is_opening: bool) -> None:
        if not is_opening:
            self.master.doubt('the link begins anew', now)
            return
        self.polls.start(now)
        if self.options.announcements:
            self._reader = AnnouncementReader(self._poll, self.announcement.assembly, self.log)
        self.master.begin(now)

    def end(self, why: str, now: float) -> None:
        self.master.end(why, now)

    def received(self, frame: Frame, now: float) -> None:
        with self.lock:
            self.master.received(frame, now)

    def damaged(self, frame: Frame, now: float) -> None:
        with self.lock:
            self.master.damaged(frame, now)

    def not_sent(self, packet: Packet, why: str) -> None:
        self.master.not_sent(packet.message, why)

    # -- what to do ---------------------------------------------------------------------

    def may_be_old(self, request: Any) -> bool:
        call = request if isinstance(request, Call) else self.master.channel.call
        return call is None or call.function.repeatable

    def submit(self, request: Call, now: float) -> List[Packet]:
        self.master.submit(request, now)
        self.wake()
        return self._stops(now)

    def stop(self, now: float, why: str = '') -> Tuple[List[Packet], str]:
        moving = '' if self.stops else self.under_way()
        for request, function in () if why else self.stops:
            self.master.submit(self.master.make(request, function, now), now)
        return self._stops(now), moving

    def due(self, now: float, is_drained: bool) -> Tuple[List[Packet], Optional[float]]:
        master, due = self.master, now + 1.0
        if master.channel.synchronised:
            due = self.polls.tick(now, self.announcement.is_current)
            text = self._reader.tick(now) if self._reader else None
            if text is not None and self.announcement.on_text:
                self.announcement.on_text(text)
        master.channel.heard(self.presence.byte_at)
        master.tick(now)
        request = master.next(now, is_drained and not self.decoder.begun)
        if request:
            return [self._packet(request)], now     # there may be more to send
        return [], min(due, master.due(now))

    def _stops(self, now: float) -> List[Packet]:
        """The requests that interrupt."""
        return [self._packet(each) for each in iter(lambda: self.master.next(now, False), None)]

    def _packet(self, request: wire.Request) -> Packet:
        return Packet(wire.encode_request(request, self.options.environment_datelen),
                      request.cmd1, request.cmd2, request.data, request)

    def under_way(self, is_reset: bool = False) -> str:
        call = self.master.channel.call
        return '' if call is None or call.function.repeatable else f'"{call.request}" is under way'

    # -- what it looks like ---------------------------------------------------------------

    def condition(self, now: float) -> Condition:
        condition = self.master.channel.condition
        unknown = self.presence.no_frame(now) if condition is NO_SYNC else ''
        return condition._replace(summary=unknown or condition.summary)

    def talks(self, now: float) -> Optional[bool]:
        # None: the board answers, perhaps SYNC alone, which the channel logs.
        condition = self.master.channel.condition
        return True if condition is READY else False if condition is NO_SYNC else None

    def shown(self, frame: Frame) -> Frame:
        call = self.master.channel.call
        if frame.cause or call is None:
            return frame
        return frame._replace(message=call.function.name_reply(frame.message))

    def error_count(self) -> int:
        return self.master.timeouts + sum(self.master.data_errors.values())

    def values(self) -> List[Tuple[str, Any]]:
        times = sorted(self.master.round_trips)
        return [('timeouts', self.master.timeouts),
                ('length errors', self.master.data_errors[LENGTH]),
                ('implausible errors', self.master.data_errors[IMPLAUSIBLE]),
                ('round trip p50 [ms]', f'{times[len(times) // 2] * 1e3:.2f}' if times else '-'),
                ('round trip max [ms]', f'{times[-1] * 1e3:.2f}' if times else '-')]


class BusLink(Link):
    """Takes requests from any thread. Each gets an outcome, whatever happens to the port."""

    session: MasterSession

    def request(self, request: wire.Request, function: wire.Function = wire.RAW,
                on_success: Optional[OnSuccess] = None) -> Outcome:
        """Send any request and wait for its outcome, which always comes: see `submit`."""
        call = self.submit(request, function, on_success)
        turn = self.session.master.queue.longest_wait + call.timeout
        if not call.over.wait((1 + self.session.options.retries) * turn):
            call.finish(Outcome(TIMEOUT, f'the bridge is stuck: {UNKNOWN}'))    # it is dropped
        assert call.outcome
        return call.outcome

    def submit(self, request: wire.Request, function: wire.Function = wire.RAW,
               on_success: Optional[OnSuccess] = None) -> Call:
        """Have a request sent, and return the call, which gets its outcome; `on_success` is called
        in the link's thread."""
        call = self.session.master.make(request, function, self.now(), on_success)
        size = len(request.data)
        try:
            if size > wire.MAX_LENGTH:
                raise Refused(f'data is {size} bytes long, may be at most {wire.MAX_LENGTH}',
                              'value')
            self.writer.submit(call)
        except Refused as refused:
            call.finish(call.without_reply(str(refused)))
        return call
