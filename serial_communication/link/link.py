"""The base of every link: what the frames of one board mean, and what is due."""
import logging
import operator
import time
from typing import Any, Callable, List, NamedTuple, Optional, Tuple

from ..framing.stream import CHECKSUM, FRAMING, UNKNOWN, Decoder, Frame, stamped
from ..transport import pace
from ..transport.port import Port, PortError
from .announcement import BoardAnnouncement
from .connection import Connection
from .lending import Lending
from .outcome import Refused  # noqa: F401  for the boards
from .presence import SILENCE, STARTUP_TIME, Presence
from .settings import BoardSettings
from .sparing_log import SparingLog
from .stamps import Stamps

OK, WARN, ERROR = 0, 1, 2      # as in diagnostic_msgs/DiagnosticStatus
RX, TX = 0, 1                  # as in SerialMsg
_ANNOUNCING = 5.0              # s after the opening in which a board announces what it sends

Tap = Callable[[str, int, Frame], None]      # gets the link's name, RX or TX, and the frame


class Report(NamedTuple):
    """The state of a link, for /diagnostics."""

    level: int
    summary: str
    values: List[Tuple[str, Any]]


class Link:
    """Base of all links. A subclass overrides the hooks below, which run in the link's thread.

    Args:
        name: of the board, in logs, `SerialMsg` and diagnostics.
        port: the link alone opens and closes it.
        frame_timeout: s without a byte after which an incomplete frame is given up.
        clock: returns the stamp of each read; it is used for nothing else.
        earlier: returns the stamp so many seconds before one of `clock`.
        now: the clock of all that the link does: seconds, monotonic, also while suspended.
        board_time: whether a frame with the board's time has the stamp of its measurement.
    """

    STOPS_FIRST = False     # True: at shutdown this link is stopped before the others
    # True: the link knows by itself which bytes are new after a stall. Else a network port, where
    # any number of old ones may wait, is then opened again.
    HAS_FENCES = False
    # True: bytes are read until no more wait before `tick` is called; see `PortState`.
    DRAINS = False
    PRINT_TO = 'another port'      # what a sketch should print to

    def __init__(self, name: str, port: Port, decoder: Decoder, frame_timeout: float = 0.05,
                 clock: Callable[[], Any] = time.time,
                 logger: Optional[logging.Logger] = None,
                 earlier: Callable[[Any, float], Any] = operator.sub,
                 board_time: bool = True, now: Callable[[], float] = pace.clock) -> None:
        self.name = name
        self.port = port
        self.decoder = decoder
        self.now = now
        self.log = SparingLog(name, logger or logging.getLogger(__name__), clock=now)
        self.tap: Optional[Tap] = None     # called with every frame in and out; None: no listener
        self.frames_received = 0           # valid ones
        self.frames_sent = 0
        self.last_frame_at: Optional[float] = None   # monotonic
        self.is_stopped = False            # by ~stop: whatever moves is refused
        self.announcement = BoardAnnouncement(self.log)
        self.presence = Presence(self.log, self.PRINT_TO)
        self.stamps = Stamps(port, earlier, self.log, board_time)
        takes_rows: Any = decoder      # that of a board with settings
        self.board_settings = BoardSettings(
            self.log, lambda kind: takes_rows.add_message(kind), lambda: self.wake(), now)
        self.connection = Connection(self, frame_timeout, clock)
        self.lending = Lending(port, self.connection.wake, self.connection.may_be_from_a_stall, now)
        self._clock = clock
        self._reported_errors = 0

    # -- hooks ------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        """The port was opened."""

    def closed(self, now: float) -> None:
        """The port was closed."""

    def received(self, frame: Frame, now: float) -> None:
        """A valid frame was received."""

    def damaged(self, frame: Frame, now: float) -> None:
        """An invalid frame or noise was received; it is already counted and logged."""

    def stalled(self, seconds: float, now: float) -> None:
        """The thread stalled for `seconds`, more than `STALL`. What is received is dropped, and not
        passed to `received`, until `AFTER_STALL` s after the stall."""

    def altered(self, now: float) -> None:
        """Another program had changed the tty's settings, which are restored now; bytes may have
        changed on the way, in both directions."""
        self.stalled(0.0, now)

    def tick(self, now: float) -> Optional[float]:
        """Do what is due; return the time of the next call at the latest, or None. PortError has
        the port closed and opened again.

        Called then, after `wake`, when no bytes are received, and every 0.1 s at the latest.
        """
        return None

    def idle(self, now: float) -> Optional[float]:
        """Like `tick`, while the port is closed."""
        return None

    def shown(self, frame: Frame) -> Frame:
        """Return what `tap` gets for a received frame; called before `received`."""
        return frame

    def talks(self, now: float) -> Optional[bool]:
        """Whether the board talks, None: unknown; changes are logged. Silence is not logged while
        the board may still be starting up."""
        return self.last_frame_at is not None and now - self.last_frame_at <= SILENCE

    def silence(self) -> str:
        """The log line for a silent board."""
        return ('the board is silent; check its power, its wiring and the baud rate '
                f'({self.port.baud})')

    # -- for callers ------------------------------------------------------------------

    def loops(self) -> List[Callable[[], float]]:
        """What the link's threads call again and again; each returns when it is due next."""
        return [self.connection.step]

    def start(self) -> None:
        """Start all threads of the link; none is started later."""
        self.connection.start()

    def stop(self) -> None:
        """Make the link's threads end; returns at once."""
        self.connection.stop()

    def join(self, timeout: float = 1.0) -> None:
        """Wait after `stop` for the port to be closed, for at most `timeout` s."""
        self.connection.join(timeout)

    def wake(self) -> None:
        """Make the thread call `tick` soon, whatever is received; from any thread."""
        self.connection.wake()

    def send(self, frame: bytes, type_: int, number: int, data: bytes, message: Any) -> None:
        """Write a frame, count it and pass it to `tap`; PortError, PortBusy: it is not written."""
        self.port.write(frame)
        self.written(frame, type_, number, data, message)

    def written(self, frame: bytes, type_: int, number: int, data: bytes, message: Any) -> None:
        """Count a frame that the port has taken, and pass it to `tap`."""
        self.frames_sent += 1
        tap = self.tap      # another thread may set it to None meanwhile
        if tap:
            # Guarded: an error here would look as if the frame had not been sent.
            self.connection.guarded(lambda tap: tap(self.name, TX, Frame(
                frame, type_, number, data, message, self._clock())), tap)

    def check_silence(self, now: float, limit: float) -> Optional[float]:
        """For `tick`: raise PortError if a network port has been silent for `limit` s (0: never).

        That drops unsent bytes, which may wait unseen in the network or in the peer's kernel.
        Return when to check again, or None.
        """
        if not limit or not self.port.is_network:
            return None
        due = self.connection.last_byte_at + limit
        if now >= due:
            raise PortError(f'nothing received from the board for {limit:g} s')
        return due

    def stop_motion(self) -> str:
        """Stop at once all that moves; `is_stopped` is true already. From any thread.

        Returns what is not stopped, or could not be written; '' if nothing.
        """
        return ''

    # -- diagnostics ------------------------------------------------------------------

    def report(self, now: float) -> Report:
        """To be called once a second: the errors since the last call are those of that second."""
        errors = self.error_count()
        # Fewer for a moment, while those of old bytes are taken back.
        new_errors, self._reported_errors = max(errors - self._reported_errors, 0), errors
        level, summary = self.condition(now)
        if level == OK and new_errors:
            level, summary = WARN, self.presence.printed(now) or (
                f'{new_errors} error{"s" if new_errors > 1 else ""} in the last second')
        name = self.condition_name(now)
        if self.is_stopped:
            level, summary, name = max(level, WARN), f'stopped by ~stop; {summary}', 'stopped'
        counted = dict(self.decoder.errors)
        values = [
            ('port', self.port.url),
            ('state', summary),
            ('condition', name),
            ('frames received', self.frames_received),
            ('frames sent', self.frames_sent),
            ('bytes received', self.port.bytes_received),
            ('bytes sent', self.port.bytes_sent),
            ('stale', self.connection.stale),
            ('checksum errors', counted.pop(CHECKSUM, 0)),
            ('framing errors', counted.pop(FRAMING)),
            ('reconnects', self.connection.reconnects),
            ('last frame age [s]', f'{now - self.last_frame_at:.3f}'
             if self.last_frame_at is not None else 'never'),
            *sorted((cause + ' errors', count) for cause, count in counted.items()),
            *self.extra_values(),
            *self.stamps.values(),
            *self.board_settings.values(),
        ]
        announcement = self.announcement
        if announcement.rows is not None:
            values += [('firmware', announcement.firmware),
                       ('announced', ', '.join(announcement.rows)),
                       ('held back', announcement.held_back)]
        return Report(level, summary, values)

    def condition(self, now: float) -> Tuple[int, str]:
        """Level and summary, without regard to new errors."""
        if self.port.is_lent:
            return WARN, str(self.port.loan)
        if not self.port.is_open:
            return ERROR, f'closed: {self.connection.trouble}'
        if self.last_frame_at is None or now - self.last_frame_at > SILENCE:
            return WARN, f'open, {self.presence.meaning(now) or "the board is silent"}'
        return OK, 'open'

    def condition_name(self, now: float) -> str:
        """The condition in one word that does not change, for programs."""
        if self.port.is_lent:
            return 'lent'
        if not self.port.is_open:
            return 'closed'
        return self.condition_of_board(now)

    def condition_of_board(self, now: float) -> str:
        """Likewise, while the port is open."""
        return 'ok' if self.talks(now) else 'silent'

    def error_count(self) -> int:
        """Errors of all causes so far."""
        return sum(self.decoder.errors.values())

    def extra_values(self) -> List[Tuple[str, Any]]:
        """Further keys and values of this kind of link."""
        return []

    # -- for the connection -----------------------------------------------------------

    def check(self, now: float) -> None:
        """Called every 0.1 s while the port is open: check what rarely changes."""
        opened_at = self.connection.opened_at
        # The board may still announce a type that is unknown now.
        self.decoder.counts_unknown = \
            self.announcement.on_text is None or now >= opened_at + _ANNOUNCING
        if now < self.presence.due:
            return
        talks = self.talks(now)
        if talks or self.presence.understood_at >= opened_at or now >= opened_at + STARTUP_TIME:
            self.presence.log(talks, self.silence(), self.now())

    def deliver(self, frame: Frame, now: float) -> None:
        """Count, log and pass on one frame, valid or not; its stamp is a `Read`."""
        tap, read = self.tap, frame.stamp
        shown = self.shown(stamped(frame, read.stamp)) if tap else frame
        frame = stamped(frame, self.stamps.of(frame, read))
        printed = '' if frame.message is not None else self.presence.not_understood(frame, now)
        if printed:
            self.log.warn('text', printed)
        elif frame.cause and (frame.cause != UNKNOWN or self.decoder.counts_unknown):
            self.log.warn(frame.cause, f'{frame.cause}: {frame.error}: {frame.raw[:24].hex()}')
        if frame.cause:
            self.damaged(frame, now)
        else:
            self.frames_received += 1
            self.last_frame_at = now
            if frame.message is not None:     # another board's bytes may be an unknown frame
                self.presence.understood(now)
            self.received(frame, now)
        if tap:
            self.connection.guarded(tap, self.name, RX, shown)
