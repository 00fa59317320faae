"""The link to one board: a port, the session of its protocol, and the thread that drives them."""
import operator
import threading
import time
import traceback
from contextlib import suppress
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

from ..framing.stream import CHECKSUM, FRAMING, FrameTimer
from ..transport import pace
from ..transport.port import Port, PortError
from .freshness import FRESH
from .lending import Lending
from .line import Line
from .outcome import Refused
from .receiver import Receiver
from .reopening import Reopening
from .session import ERROR, OK, WARN, Doubt, Session
from .sparing_log import SparingLog
from .stamps import Stamps
from .writer import Writer

_LONGEST_SLEEP = 0.1           # s
_LOOK_AT_SETTINGS = 1.0        # s from one look at the settings of a tty to the next
_LEAVES = 0.1                  # s for what stops to leave the port before it is closed
_AGAIN = 0.05                  # s until what could not be written is tried again
_NEVER = float('inf')
_AFTER_FAULT = 0.1             # s until a thread goes on after an unexpected error
_PRIORITY = 20                 # of the heartbeat's thread
_NO_PRIORITY = ('no real-time priority for the heartbeat: it may be late while the computer is '
                f'busy. To allow it, put the line "@dialout - rtprio {_PRIORITY}" into a file in '
                '/etc/security/limits.d/, add the user to that group, and log in again')


class Report(NamedTuple):
    """What /diagnostics shows of a link."""

    level: int
    summary: str
    values: List[Tuple[str, Any]]


class Link:
    """Serves one board. Its thread does round after round, `step`: it opens the port, reads, gives
    frames to the session, and writes what is due. It sleeps in the port alone. Commands are written
    by the threads that give them, heartbeats by a thread of their own: see `Writer`.

    Args:
        port: the link alone opens and closes it.
        frame_timeout: s without a byte after which an incomplete frame is given up.
        clock: returns the stamp of each read; it is used for nothing else.
        earlier: returns the stamp so many seconds before one of `clock`.
        now: the clock of all that the link does: seconds, monotonic, also while suspended.
        board_time: whether a frame with the board's time has the stamp of its measurement.
    """

    def __init__(self, port: Port, session: Session, frame_timeout: float = 0.05,
                 clock: Callable[[], Any] = time.time,
                 earlier: Callable[[Any, float], Any] = operator.sub,
                 board_time: bool = True, now: Callable[[], float] = pace.clock) -> None:
        self.port, self.session, self.now = port, session, now
        session.line = Line(10.0 / port.baud, port.is_network)
        self.reopening = Reopening(port.url, session.log)
        self.writer = Writer(port, session, self.reopening, clock, now)
        self.lending = Lending(port, session, self.writer, now)
        self.receiver = Receiver(session, FrameTimer(session.decoder, frame_timeout, port.baud),
                                 Stamps(port, earlier, session.log, board_time))
        self._clock = clock
        self._due = 0.0                 # the next round, at the latest
        self._look_at = 0.0             # when to ask the session what is due
        self._settings_at = 0.0         # when to look at the settings of a tty
        self._publishes_at = 0.0        # what is received before is old
        self._reported_errors = 0       # those until the latest report
        self._threads: Dict[str, threading.Thread] = {}
        session.wake = self.wake

    @property
    def name(self) -> str:
        """Of the board, in logs, `SerialMsg` and diagnostics."""
        return self.session.NAME

    @property
    def log(self) -> SparingLog:
        """Of this link."""
        return self.session.log

    # -- for any thread -----------------------------------------------------------------

    def loops(self) -> Dict[str, Callable[[], float]]:
        """What each thread of the link calls again and again; each returns when it is due next."""
        beats = {'heartbeat': self.writer.beat} if self.session.BEATS else {}
        return {'link': self.step, **beats}

    def start(self) -> None:
        """Start all threads of the link; none is started later."""
        for what, step in self.loops().items():
            thread = threading.Thread(target=self._repeat, args=(step, what == 'heartbeat'),
                                      name=f'{self.name} {what}', daemon=True)
            thread.start()
            self._threads[what] = thread
        if self.session.BEATS:
            has_it = pace.set_priority(_PRIORITY, self._threads['heartbeat'].native_id or 0)
            self.log.info('priority', 'the heartbeat has real-time priority' if has_it else
                          _NO_PRIORITY)

    def _repeat(self, step: Callable[[], float], sleeps: bool) -> None:
        """Call a step until it is never due again. Errors, and a lack of memory, do not end it. It
        `sleeps` until a step is due that does not wait itself."""
        due = 0.0
        while due < _NEVER:
            try:
                if sleeps:
                    time.sleep(max(due - self.now(), 0.0))
                due = step()
            except BaseException:  # pylint: disable=broad-except
                with suppress(BaseException):       # there may be too little memory to log it
                    self.log.error('fault', traceback.format_exc())
                time.sleep(_AFTER_FAULT)

    def stop(self) -> None:
        """Stop what moves, and send nothing after it; have the threads end."""
        with self.session.lock:
            if self.port.is_open:
                self.writer.stop('the bridge is stopping')
            self.writer.has_ended = True
        self.port.wake()

    def join(self, timeout: float = 1.0) -> None:
        """Wait after `stop` for the port to be closed, for at most `timeout` s."""
        if self._threads:
            self._threads['link'].join(timeout)

    def wake(self) -> None:
        """Make the thread look soon for what is due, whatever is received."""
        self._look_at = 0.0
        self.port.wake()

    def stop_motion(self) -> str:
        """Stop at once all that moves; the session is stopped already.

        Returns what is not stopped, or could not be written; '' if nothing.
        """
        with self.session.lock:
            return self.writer.stop() if self.port.is_open else 'the port is closed'

    def report(self, now: float) -> Report:
        """To be called once a second: the errors since the last call are those of that second."""
        session, port = self.session, self.port
        if self.lending.runs:
            level, name, summary = WARN, 'lent', f'lent to {self.lending.by}'
        elif not port.is_open:
            level, name, summary = ERROR, 'closed', f'closed: {self.reopening.trouble}'
        else:
            level, name, summary = session.condition(now)
        errors = sum(session.errors.values()) + session.timeouts
        new, self._reported_errors = errors - self._reported_errors, errors
        if level == OK and new:
            level, summary = WARN, f'{new} error{"s" if new > 1 else ""} in the last second'
        if session.is_stopped:
            level, name, summary = max(level, WARN), 'stopped', f'stopped by ~stop; {summary}'
        counted = dict(session.errors)
        frame_at, announcement = session.presence.frame_at, session.announcement
        values = [
            ('port', port.url),
            ('state', summary),
            ('condition', name),
            ('frames received', session.frames_received),
            ('frames sent', session.frames_sent),
            ('bytes received', port.bytes_received),
            ('bytes sent', port.bytes_sent),
            ('stale', session.stale),
            ('checksum errors', counted.pop(CHECKSUM, 0)),
            ('framing errors', counted.pop(FRAMING, 0)),
            ('reconnects', max(self.reopening.count - 1, 0)),
            ('last frame age [s]', 'never' if frame_at is None else f'{now - frame_at:.3f}'),
            *sorted((cause + ' errors', count) for cause, count in counted.items()),
            *session.values(),
            *self.receiver.stamps.values(),
        ]
        if announcement.rows is not None:
            values += [('firmware', announcement.firmware),
                       ('announced', ', '.join(announcement.rows)),
                       ('held back', announcement.held_back)]
        return Report(level, summary, values)

    # -- rounds, in the link's thread -------------------------------------------------------

    def step(self) -> float:
        """Sleep in the port until something is due or received, and do it; return when the next
        round is due."""
        try:
            if self.writer.has_ended:
                self._close()
                self._due = _NEVER
            elif self.port.is_open:
                self._due = self._open_round()
            else:
                self._due = self._closed_round()
        except PortError as error:
            self._lost(str(error))
        except Exception as error:  # pylint: disable=broad-except
            self.session.log.error('fault', traceback.format_exc())
            self._lost(f'fault in the bridge: {error!r}')
        return self._due

    def _closed_round(self) -> float:
        self.port.pause(self._due - self.now())
        now = self.now()
        self._awake(now)
        with self.session.lock:
            due = self.session.idle(now)
        if now >= self.reopening.at and not self.lending.runs and not self.writer.has_ended:
            try:
                self._open()
                return self.now()
            except Exception as error:  # pylint: disable=broad-except
                self.port.close()
                self.reopening.failed(str(error) or repr(error), self.now())
        opens_at = self.lending.until if self.lending.runs else self.reopening.at
        return min(opens_at, now + _LONGEST_SLEEP, _NEVER if due is None else due)

    def _open(self) -> None:
        lending = self.lending
        if lending.by and self.port.is_used():
            raise PortError(f'it was lent to {lending.by}, and another program still has it open')
        self.writer.fresh.rest('link')
        try:
            self.port.open()
        finally:        # a stall may follow at once, whether it is open or not
            now = self.now()
            self.writer.fresh.awake('link', now)
        self.reopening.opened(now)
        self.receiver.reset()
        lending.closed.clear()
        self._look_at, self._settings_at = now, now + _LOOK_AT_SETTINGS
        with self.session.lock:
            self.session.presence.opened(now)
            self.writer.opened(now)
            self.session.begin(now, is_opening=True)
            if lending.runs:        # since the opening has begun
                self.port.give_up(f'lent to {lending.by}')
            else:
                lending.by = ''

    def _lost(self, why: str) -> None:
        """The port is gone, or given up."""
        now = self.now()
        self.reopening.lost(why, now)
        self._close()
        self._due = now

    def _close(self) -> None:
        if not self.port.is_open:
            return
        if self.writer.has_ended or self.lending.runs:
            self.port.drain(_LEAVES)
        with self.session.lock:
            self.port.close()
            self.session.announcement.assembly.reset()      # before any thread can write again
            self.session.end(self.reopening.trouble, self.now())
        self.lending.closed.set()

    def _open_round(self) -> float:
        session, receiver = self.session, self.receiver
        data = self.port.read(self._due - self.now())
        # The clock after that: what it takes to make its stamp varies, and is not in `now`.
        now = self.now()
        stamp = self._clock()
        stall = self._awake(now)
        if stall:       # what waited is old, and would get a new stamp
            with session.lock:
                self.writer.begin_anew(stall, keeps_port=session.FENCED and self.port.is_network)
        if self.writer.drops_input:
            self.writer.drops_input = False
            receiver.reset()
        has_come = receiver.take(data, stamp, now,
                                 is_old=now < self._publishes_at and not session.FENCED)
        if data:
            self.writer.is_silent = False
        if not has_come or now >= self._look_at:
            self._look_at = self._look(now, not has_come)
        if session.FENCED and has_come:
            return now
        frame_due = receiver.due()
        return self._look_at if frame_due is None else min(self._look_at, frame_due)

    def _awake(self, now: float) -> str:
        """This thread runs; as `Freshness.awake`."""
        stall = self.writer.fresh.awake('link', now, self._clock)
        if stall:
            self._publishes_at = now + FRESH
        return stall

    def _look(self, now: float, is_drained: bool) -> float:
        """Do what is due, and look at what rarely changes; return when to do that again."""
        session = self.session
        with session.lock:
            self.writer.check_output(now)
            self._check_port(now)
            due: Optional[float] = now + _AGAIN
            try:
                packets, due = session.due(now, is_drained)
                self.writer.transmit(packets, now)
            except Doubt as doubt:
                self.writer.begin_anew(str(doubt))
            except Refused:
                pass        # the session was told
        session.presence.check(session.talks(now), self.port.baud, now)
        return now + _LONGEST_SLEEP if due is None else min(due, now + _LONGEST_SLEEP)

    def _check_port(self, now: float) -> None:
        """Begin anew where the port may hold something back, or change it."""
        session, presence = self.session, self.session.presence
        limit = session.network_silence if session.reads else 0.0
        if self.port.hides and presence.frame_at is not None and not self.writer.is_silent \
                and 0 < limit <= now - presence.byte_at:
            self.writer.is_silent = True
            self.writer.begin_anew(f'nothing received from the board for {limit:g} s')
        if now >= self._settings_at:
            self._settings_at = now + _LOOK_AT_SETTINGS
            if self.port.changed_settings():
                self.writer.begin_anew(
                    f'{self.port.url}: another program changed the settings of this port; keep '
                    'other programs (stty, a serial monitor) off it')
