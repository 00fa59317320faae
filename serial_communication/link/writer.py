"""All that is written to a port, from any thread: requests, what stops, heartbeats."""
from typing import Any, Callable, Sequence

from ..framing.stream import Frame
from ..transport.port import Port, PortBusy, PortError
from .freshness import Freshness, stall
from .outcome import Refused
from .reopening import Reopening
from .session import TX, Doubt, Packet, Session

STALLED = 'it may have waited while the bridge stalled; send it again'
_AT_END = 0.05                 # s that bytes may wait in the port before what stops goes out
_NEVER = float('inf')


class Writer:
    """The only way to the board: with the session's lock held, what is decided is written at once.
    The arguments are those of the link.
    """

    def __init__(self, port: Port, session: Session, reopening: Reopening,
                 clock: Callable[[], Any], now: Callable[[], float]) -> None:
        self.fresh = Freshness()
        self.has_ended = False      # nothing may follow what was written last
        self.is_silent = False      # a port that hides what it has not sent is silent
        self.drops_input = False    # the decoder has to begin anew
        self._port, self._session, self._reopening = port, session, reopening
        self._clock, self._now = clock, now

    def submit(self, request: Any, stamp: Any = None) -> None:
        """Have the session take a request, which was made at `stamp` (None: unknown), and write
        what that sends; Refused: nothing of it was sent."""
        with self._session.lock:
            now = self._now()
            self._admit(request, now, stamp)
            self.transmit(self._session.submit(request, now), now)

    def write(self, decide: Callable[[float], Sequence[Packet]]) -> None:
        """Write what `decide` returns, with the lock held; if the port is closed nothing is."""
        with self._session.lock:
            now = self._now()
            packets = decide(now)
            if self._port.is_usable and not self.has_ended:
                self.transmit(packets, now)

    def _admit(self, request: Any, now: float, stamp: Any) -> None:
        """Raise Refused for a request that the port or a stall does not allow."""
        may_be_old = self._session.may_be_old(request)
        if self.has_ended:
            raise Refused('the bridge is stopping', 'stopping')
        if not self._port.is_usable:
            raise Refused(f'the port {self._port.url} is closed ({self._reopening.trouble})',
                          'port')
        if not may_be_old and not self.fresh.is_fresh(now, stamp):
            raise Refused(STALLED, 'stall')
        if not may_be_old and self.is_silent:
            raise Refused('the board is silent, so the other side of the pseudo terminal may hold '
                          'it back', 'silent')
        if self._session.line.stands and not self._session.FENCED:     # whose requests wait anyway
            raise Refused('the port takes no data', 'busy')

    def opened(self, now: float) -> None:
        """The port was opened."""
        self.is_silent = self.drops_input = self._session.line.stands = False
        self._session.line.dropped(now)

    # -- the lock is held -----------------------------------------------------------------

    def transmit(self, packets: Sequence[Packet], now: float) -> None:
        """Write packets that were decided at `now`; Refused if one of them is not written."""
        session = self._session
        for index, packet in enumerate(packets):
            try:
                why = stall(self._now() - now)
                if why and not session.may_be_old(packet.message):
                    raise Doubt(why)
                frame = session.ENDS_FRAME + packet.frame if session.line.is_cut else packet.frame
                self._port.write(frame)
            except (Doubt, PortBusy, PortError) as error:
                self._failed(packets[index:], error)
            session.line.wrote(len(frame), now)
            session.frames_sent += 1
            session.sent(packet, now)
            if session.tap:
                session.tapped(TX, Frame(*packet, self._clock()))

    def _failed(self, packets: Sequence[Packet], error: Exception) -> None:
        """The first of these packets was not written."""
        for packet in packets:
            self._session.not_sent(packet, str(error))
        if isinstance(error, PortError):
            raise Refused(str(error), 'port') from None
        is_busy = isinstance(error, PortBusy)
        self._session.line.stands |= is_busy
        self.begin_anew(str(error))
        raise Refused(str(error) if is_busy else STALLED, 'busy' if is_busy else 'stall') from None

    def stop(self, why: str = '') -> str:
        """Write what stops all that moves; return what is not stopped, or ''.

        Args:
            why: the port is given up then, for this reason: nothing may follow.
        """
        self.check_output(self._now(), _AT_END)     # what waits is older, and may be a speed
        failure = ''
        for _ in range(2):
            now = self._now()
            packets, moves = self._session.stop(now, why)
            try:
                self.transmit(packets, now)
                return moves or ('the port takes no data' if self._session.line.stands else '')
            except Refused as refused:
                failure = str(refused)
        return failure

    def check_output(self, now: float, longest: float = 0.0) -> None:
        """Begin anew if bytes wait in a port that sends nothing."""
        line = self._session.line
        if not line.is_stuck(self._port.unsent(), now, longest):
            return
        line.stands = True
        if self._session.reads:
            self.begin_anew('the port takes no data')
        else:
            self._port.renew(keeps_input=True)
            line.dropped(now)

    def begin_anew(self, why: str, keeps_input: bool = False, keeps_port: bool = False) -> None:
        """Drop what waits, unless it is kept, and have the session begin as after an opening."""
        now = self._now()
        self._session.log.warn('doubt', f'{why}: what waits in the port is dropped, and the link '
                               'begins anew')
        if not keeps_port:
            if self._port.is_network:
                self._port.give_up(why)
            keeps_input |= self._session.FENCED
            self._session.stale += self._port.renew(keeps_input)
            self._session.line.dropped(now)
            self.drops_input |= not keeps_input
        self._session.begin(now, is_opening=False)
        self._session.wake()

    # -- the heartbeat's thread -----------------------------------------------------------

    def beat(self) -> float:
        """Write a heartbeat, and zeros, that are due; return when to be called next."""
        if self.has_ended:
            return _NEVER
        with self._session.lock:
            now = self._now()       # read with the lock held: the bridge may stall while it waits
            why = self.fresh.awake('beat', now, self._clock)
            try:
                if why:
                    self.begin_anew(why, keeps_input=True)
                is_usable = self._port.is_usable and not self.has_ended
                if is_usable:
                    self.check_output(now)
                packets, due = self._session.beat(now)      # after a doubt zeros come first
                if is_usable:
                    self.transmit(packets, now)
            except Refused:
                pass        # the link's thread gets it, too, and logs it
        return due
