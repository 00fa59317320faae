"""What every link has: one port, one thread that opens and reads it, and its counters."""
import logging
import threading
import time
import traceback
from typing import Any, Callable, List, NamedTuple, Optional, Tuple

from ..framing.frame_timer import FrameTimer
from ..framing.stream import CHECKSUM, FRAMING, Decoder, Frame
from ..transport import pace
from ..transport.opener import Opener
from ..transport.port import Port, PortError
from .backlog import LONGEST_SLEEP, STALL, Backlog
from .presence import FIRST_WORD, LOOK_PERIOD, Presence
from .sparing_log import SparingLog

OK, WARN, ERROR = 0, 1, 2      # as diagnostic_msgs/DiagnosticStatus has them
RX, TX = 0, 1                  # as SerialMsg has them
SILENCE = 1.0                  # s without a frame after which a talking board counts as silent
_BOTH_END = 0.5                # s in which the bridge may be told to end, too, when a port goes
_AFTER_FAULT = 0.1             # s until the thread goes on after a fault of its own
_NEVER = float('inf')
_OLD = object()                # in the place of a stamp: what has waited during a stall

Tap = Callable[[str, int, Frame], None]


class Refused(Exception):
    """A command was not sent; the text says why, for a person, and `cause` in a word or two."""

    def __init__(self, text: str, cause: str) -> None:
        super().__init__(text)
        self.cause = cause


class Report(NamedTuple):
    """How a link is, for /diagnostics."""

    level: int
    summary: str
    values: List[Tuple[str, Any]]


class Link:
    """Base of the three links. A subclass overrides the hooks below; all run in the thread.

    Args:
        name: bus, arduino or mcu; in logs, `SerialMsg` and diagnostics.
        port: opened and closed here, nowhere else.
        decoder: of what the board sends.
        frame_timeout: seconds without a byte after which an incomplete frame is given up.
        clock: what stamps a read; not used for anything else.
        logger: where lines for people go.
    """

    STOPS_FIRST = False     # True: what it says last must not wait for other links

    def __init__(self, name: str, port: Port, decoder: Decoder, frame_timeout: float = 0.05,
                 clock: Callable[[], Any] = time.time,
                 logger: Optional[logging.Logger] = None) -> None:
        self.name = name
        self.port = port
        self.decoder = decoder
        self.log = SparingLog(name, logger or logging.getLogger(__name__))
        self.tap: Optional[Tap] = None     # is given every frame in and out; None: nobody listens
        self.frames_received = 0
        self.frames_sent = 0
        self.last_frame_at: Optional[float] = None   # monotonic
        self.last_byte_at = 0.0                      # monotonic
        self.stale = 0                     # bytes that waited while the thread stalled: dropped
        # When the thread was last seen at work, by `pace.clock`; while it serves no port, never.
        self.awake_at = _NEVER
        self._clock = clock
        self._timer = FrameTimer(decoder, frame_timeout, port.baud)
        self.connections = 0               # how often the port has been opened
        self._trouble = ''                 # why the port is closed
        self._lost = ''                    # how it was lost, while that is not said yet …
        self._lost_at = 0.0                # … and when
        self._opener = Opener(port, name + ' opening', self._port_opened)
        self._stopping = self._opener.ending
        self._thread = threading.Thread(target=self._run, name=name + ' link', daemon=True)
        self._reported_errors = 0
        self._presence = Presence(self.log)
        self._opened_at = self._presence_at = 0.0    # monotonic
        self._backlog: Optional[Backlog] = None      # while old bytes are dropped
        # Whether the latest read found nothing, and nothing has been delivered since.
        self.drained = False

    # -- hooks ------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        """The port is open."""

    def closed(self, now: float) -> None:
        """The port has been closed."""

    def received(self, frame: Frame, now: float) -> None:
        """A good frame has come."""

    def damaged(self, frame: Frame, now: float) -> None:
        """Bytes have come that are no good frame; they are counted and logged already."""

    def stalled(self, seconds: float, now: float) -> None:
        """The thread was not at work for so long (over `STALL`), whatever kept it from that. What
        the port has is old: it is dropped, and nothing is `received` until it is through."""

    def altered(self, now: float) -> None:
        """Another program changed the tty's settings for a moment: bytes either way may be others
        than those that were sent."""
        self.stalled(0.0, now)

    def tick(self, now: float) -> Optional[float]:
        """Do what is due by time; return when to be called next at the latest, or None."""
        return None

    def idle(self, now: float) -> Optional[float]:
        """`tick` while the port is closed; asked at least once a second."""
        return None

    def shown(self, frame: Frame) -> Frame:
        """A frame that has come, as listeners see it, before it is `received`."""
        return frame

    def talks(self, now: float) -> Optional[bool]:
        """Whether the board talks; None where that cannot be told. Looked at while the port is
        open, and said in the log when it changes; silence not while the board may still start."""
        return self.last_frame_at is not None and now - self.last_frame_at <= SILENCE

    def silence(self) -> str:
        """How the log tells of a board that does not talk."""
        return ('the board is silent; has it power, is it wired, and is '
                f'{self.port.baud} baud right?')

    @property
    def reconnects(self) -> int:
        """How often the port has been opened again."""
        return max(self.connections - 1, 0)

    @property
    def drops(self) -> bool:
        """Whether what comes is dropped now, after a stall."""
        return self._backlog is not None

    # -- for users --------------------------------------------------------------------

    def start(self) -> None:
        """Start its threads: none is started later."""
        self._opener.start()
        self._thread.start()

    def stop(self) -> None:
        """Begin to end; returns at once."""
        self._opener.end()
        self.port.wake()

    def join(self, timeout: float = 1.0) -> None:
        """After `stop`: wait for the thread, which closes the port as it ends."""
        if self._thread.is_alive():
            self._thread.join(timeout)

    def wake(self) -> None:
        """Have `tick` called soon."""
        self.port.wake()

    def send(self, frame: bytes, type_: int, command: int, data: bytes, message: Any) -> None:
        """Write one frame; PortError or PortBusy where it cannot be."""
        self.port.write(frame)
        self.written(frame, type_, command, data, message)

    def written(self, frame: bytes, type_: int, command: int, data: bytes, message: Any) -> None:
        """Count a frame that the port has taken, and show it to who listens."""
        self.frames_sent += 1
        tap = self.tap      # another thread may take it away meanwhile
        if tap:
            # Guarded, since whoever sends must not take a sent frame for one that was not.
            self._guarded(lambda: tap(self.name, TX, Frame(frame, type_, command, data, message,
                                                           self._clock())))

    def check_silence(self, now: float, limit: float) -> Optional[float]:
        """For `tick`: when to look again whether a network port has been silent for `limit` s.

        The network and the peer's kernel hide what has not arrived, so a connection on which
        nothing comes is given up. None: it may be silent (another kind of port, or a limit of 0).

        Raises:
            PortError: nothing has come for so long.
        """
        if not limit or not self.port.is_network:
            return None
        due = self.last_byte_at + limit
        if now >= due:
            raise PortError(f'the board has not been heard for {limit:g} s')
        return due

    # -- diagnostics ------------------------------------------------------------------

    def report(self, now: float) -> Report:
        """How the link is; to be asked once a second, since errors count from the last time."""
        errors = self.error_count()
        new_errors, self._reported_errors = errors - self._reported_errors, errors
        level, summary = self.condition(now)
        if level == OK and new_errors:
            level, summary = WARN, (f'{new_errors} error{"s" if new_errors > 1 else ""} '
                                    'in the last second')
        counted = dict(self.decoder.errors)
        checksum = counted.pop(CHECKSUM, 0)
        framing = counted.pop(FRAMING)
        values = [
            ('port', self.port.url),
            ('state', summary),
            ('frames received', self.frames_received),
            ('frames sent', self.frames_sent),
            ('bytes received', self.port.bytes_received),
            ('bytes sent', self.port.bytes_sent),
            ('stale', self.stale),
            ('checksum errors', checksum),
            ('framing errors', framing),
            ('reconnects', self.reconnects),
            ('last frame age [s]', f'{now - self.last_frame_at:.3f}'
             if self.last_frame_at is not None else 'never'),
        ]
        values += sorted((cause + ' errors', count) for cause, count in counted.items())
        return Report(level, summary, values + self.own_values())

    def condition(self, now: float) -> Tuple[int, str]:
        """Level and a few words, new errors aside."""
        if not self.port.is_open:
            return ERROR, f'closed: {self._trouble or "not opened yet"}'
        if self.last_frame_at is None or now - self.last_frame_at > SILENCE:
            return WARN, 'open, the board is silent'
        return OK, 'open'

    def error_count(self) -> int:
        """All that went wrong on the line so far."""
        return sum(self.decoder.errors.values())

    def own_values(self) -> List[Tuple[str, Any]]:
        """Key-value pairs that only this kind of link has."""
        return []

    # -- the thread -------------------------------------------------------------------

    def _run(self) -> None:
        """Nothing that a hook or a callback raises ends this, nor that no memory is left."""
        while not self._stopping.is_set():
            try:
                self._come_and_go()
            except BaseException:  # pylint: disable=broad-except
                time.sleep(_AFTER_FAULT)    # not even enough to log what was raised

    def _come_and_go(self) -> None:
        """Connection after connection."""
        if self.port.is_open:       # where this has ended of a fault
            self._leave()
        while self._opener.open(self._not_opened, lambda now: self._guarded(self.idle, now)):
            self._guarded(self._serve)
            self._leave()

    def _leave(self) -> None:
        self.awake_at = _NEVER
        self._guarded(self.port.close)
        self._guarded(self.closed, time.monotonic())

    def _port_opened(self) -> None:
        """In the opener's thread: from now on bytes wait in the port."""
        self.awake_at = pace.clock()

    def _not_opened(self, trouble: str) -> None:
        self.awake_at = _NEVER
        self._trouble = trouble
        # Where all ends together, a simulated board's port goes first: that is nobody's trouble.
        if time.monotonic() >= self._lost_at + _BOTH_END:
            self._report_loss()
            self.log.warn('closed', f'{self.port.url}: {trouble}')

    def _report_loss(self) -> None:
        if self._lost:
            self.log.warn('lost', self._lost)
            self._lost = ''

    def _guarded(self, function: Callable, *arguments: Any) -> Any:
        """Call it; what it raises is logged and kept as the link's trouble, and None returned."""
        try:
            return function(*arguments)
        except PortError as error:
            self._trouble = str(error)
            self._lost = f'{self.port.url}: {error}; opening it again when it returns'
            self._lost_at = time.monotonic()
        except BaseException as error:  # pylint: disable=broad-except
            # Also what would end this thread alone, as SystemExit does.
            self._trouble = f'fault in the bridge: {error!r}'
            if not self._stopping.is_set():
                self.log.error('fault', traceback.format_exc())
        return None

    def _serve(self) -> None:
        """Read until the port goes or the link stops."""
        self._report_loss()
        self.connections += 1
        self.log.info('opened', f'{self.port.url}: open')
        self.decoder.reset()
        now = time.monotonic()
        self.opened(now)
        self.last_byte_at = self._opened_at = self._presence_at = look_at = now
        self._backlog = None
        self.drained = False
        timer = self._timer
        timer.reset()
        while not self._stopping.is_set():
            wake_at = now + LONGEST_SLEEP
            due = self.tick(now)
            if due is not None and due < wake_at:
                wake_at = due
            if now >= look_at:
                look_at = now + LONGEST_SLEEP
                self._look(now)
            if self.decoder.pending:
                wake_at = min(wake_at, timer.due(self.last_byte_at, now))
            data = self.port.read(wake_at - now)
            stamp = self._clock()
            now = time.monotonic()
            self.drained = not data
            self._look_for_stall(now)
            if self._backlog is not None:
                self._drop(data, now)
            elif data:
                self.take(data, stamp, now)
            if self.decoder.pending:
                self._deliver(timer.overdue(self.last_byte_at, now), now)

    def _look(self, now: float) -> None:
        """Look at what changes seldom: the settings of the port, and whether the board talks."""
        changed = self.port.restore_settings()
        if changed:
            self.log.warn('settings', f'{self.port.url}: another program changed the settings of '
                          f'this port ({changed}). They have been put right, and what waited in '
                          'it was dropped; keep other programs (stty, a serial monitor) off it')
            self.decoder.reset()
            self.altered(now)
        if now >= self._presence_at:
            self._presence_at = now + LOOK_PERIOD
            talks = self.talks(now)
            has_talked = self.last_frame_at is not None and self.last_frame_at >= self._opened_at
            if talks or has_talked or now >= self._opened_at + FIRST_WORD:
                self._presence.see(talks, self.silence(), now)

    def _look_for_stall(self, now: float) -> None:
        awake_at = pace.clock()
        seconds = awake_at - self.awake_at
        if seconds > STALL:
            if self._backlog is None:
                self._backlog = Backlog(self.port.baud, seconds, awake_at)
                self.decoder.reset()
            else:
                self._backlog.extend(seconds, awake_at)
            self.stalled(seconds, now)
        self.awake_at = awake_at

    def _drop(self, data: bytes, now: float) -> None:
        """Take what was read as old."""
        backlog = self._backlog
        self.stale += len(data)
        if data:
            self.last_byte_at = now
        if not backlog.drop(data, self.awake_at):
            return
        self._backlog = None
        if backlog.size:
            self.log.warn('stalled', f'the bridge stalled for {backlog.seconds:.3g} s: '
                          f'{backlog.size} bytes that waited in the port are old and were dropped')
        # A frame that began among them ends in what comes next: the rest of it alone could be
        # taken for another frame where frames carry no checksum.
        errors = dict(self.decoder.errors)
        self.decoder.feed(backlog.last, _OLD)
        self.decoder.errors.update(errors)

    def take(self, data: bytes, stamp: Any, now: float) -> None:
        """Decode what was read and pass it on."""
        self.last_byte_at = now
        self._deliver(self.decoder.feed(data, stamp), now)

    def _deliver(self, frames: List[Frame], now: float) -> None:
        tap = self.tap
        for frame in frames:
            if frame.stamp is _OLD:
                continue
            self.drained = False
            shown = self.shown(frame) if tap else frame
            if frame.cause:
                self.log.warn(frame.cause, f'{frame.cause}: {frame.error}: {frame.raw[:24].hex()}')
                self.damaged(frame, now)
            else:
                self.frames_received += 1
                self.last_frame_at = now
                self.received(frame, now)
            if tap:
                self._guarded(tap, self.name, RX, shown)
