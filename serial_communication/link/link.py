"""The base of every link: one port, the thread that opens and reads it, and its counters."""
import logging
import threading
import time
import traceback
from typing import Any, Callable, Iterable, List, NamedTuple, Optional, Tuple

from ..framing.announcement import Assembly, Chunk
from ..framing.frame_timer import FrameTimer
from ..framing.stream import CHECKSUM, FRAMING, Decoder, Frame
from ..transport import pace
from ..transport.opener import Opener
from ..transport.port import Port, PortError
from .presence import LOOK_PERIOD, STARTUP_TIME, PresenceLog
from .sparing_log import SparingLog
from .stall import LONGEST_SLEEP, STALL, StallWatch
from .unknown_bytes import OtherBoard, UnknownBytes

OK, WARN, ERROR = 0, 1, 2      # as in diagnostic_msgs/DiagnosticStatus
RX, TX = 0, 1                  # as in SerialMsg
SILENCE = 1.0                  # s without a frame after which a board counts as silent
_SHUTDOWN_TIME = 0.5           # s within which bridge and simulated boards end if stopped together
_AFTER_FAULT = 0.1             # s until the thread goes on after an unexpected error
_OLD = object()                # the stamp of bytes that waited during a stall

Tap = Callable[[str, int, Frame], None]      # gets the link's name, RX or TX, and the frame


class Refused(Exception):
    """A command was not sent; the text says why.

    Args:
        cause: why, in a word or two; lines with the same cause are logged sparingly.
    """

    def __init__(self, text: str, cause: str) -> None:
        super().__init__(text)
        self.cause = cause


class Announced(NamedTuple):
    """What the board announces and the bridge uses, for /diagnostics."""

    firmware: str       # NAME VERSION; '' if it announces none
    rows: List[str]     # the names of the rows


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
        decoder: for the bytes that the board sends.
        frame_timeout: s without a byte after which an incomplete frame is given up.
        clock: returns the stamp of each read; it is used for nothing else.
        logger: None: the logger of this module.
        other_boards: boards to recognise if their frames are received instead of this board's.
    """

    STOPS_FIRST = False     # True: at shutdown this link is stopped before the others
    # True: the link knows by itself which bytes are new after a stall. Else a network port, where
    # any number of old ones may wait, is then opened again.
    HAS_FENCES = False

    def __init__(self, name: str, port: Port, decoder: Decoder, frame_timeout: float = 0.05,
                 clock: Callable[[], Any] = time.time,
                 logger: Optional[logging.Logger] = None,
                 other_boards: Iterable[OtherBoard] = ()) -> None:
        self.name = name
        self.port = port
        self.decoder = decoder
        self.log = SparingLog(name, logger or logging.getLogger(__name__))
        self.tap: Optional[Tap] = None     # called with every frame in and out; None: no listener
        self.frames_received = 0           # valid ones
        self.frames_sent = 0
        self.last_frame_at: Optional[float] = None   # monotonic
        self.last_byte_at = 0.0                      # monotonic
        self._understood_at = float('-inf')          # the latest frame of a known type; monotonic
        self.stale = 0                     # bytes dropped because they waited during a stall
        # Called in the link's thread with each new text that the board announces; None: ignore it.
        self.on_announcement: Optional[Callable[[bytes], None]] = None
        self.announcement = Assembly()
        self.announced: Optional[Announced] = None   # None: nothing was announced
        self.text_in_use: Optional[bytes] = None     # the announcement whose rows are in use
        self.held_back = 0                 # values of announced rows: see `holds_back`
        self._stalls = StallWatch(STALL)   # of the thread; by `pace.clock`
        self._clock = clock
        self._timer = FrameTimer(decoder, frame_timeout, port.baud)
        self.connections = 0               # how often the port has been opened
        self._trouble = ''                 # why the port is closed
        self._lost = ''                    # why the port was lost; '': not lost, or already logged
        self._lost_at = 0.0                # when; monotonic
        self._opener = Opener(port, name + ' opening')
        self._stopping = self._opener.ending
        self._thread = threading.Thread(target=self._run, name=name + ' link', daemon=True)
        self._reported_errors = 0
        self._presence = PresenceLog(self.log)
        self._unknown_bytes = UnknownBytes(
            other for other in other_boards if other.name != name)
        self._opened_at = self._presence_at = 0.0    # monotonic
        self._stall = 0.0     # s; of the stall during which received bytes waited; 0.0: none
        self._dropped = 0     # of them
        # Whether the latest read returned nothing, and no frame has been delivered since.
        self.drained = False

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
        """The thread stalled for `seconds`, which are more than `STALL`.

        After this call what is received is dropped until `AFTER_STALL` s after the stall, and
        `received` is not called.
        """

    def altered(self, now: float) -> None:
        """Another program had changed the tty's settings, which are restored now.

        Bytes may have changed on the way, in both directions.
        """
        self.stalled(0.0, now)

    def tick(self, now: float) -> Optional[float]:
        """Do what is due; return the time of the next call at the latest, or None.

        Raises:
            PortError: to have the port closed and opened again.
        """
        return None

    def idle(self, now: float) -> Optional[float]:
        """Like `tick`, while the port is closed; called at least once a second."""
        return None

    def shown(self, frame: Frame) -> Frame:
        """Return what `tap` gets for a received frame; called before `received`."""
        return frame

    def talks(self, now: float) -> Optional[bool]:
        """Whether the board talks; None: unknown.

        Asked while the port is open; changes are logged. Silence is not logged while the board
        may still be starting up.
        """
        return self.last_frame_at is not None and now - self.last_frame_at <= SILENCE

    def silence(self) -> str:
        """The log line for a silent board."""
        return ('the board is silent; check its power, its wiring and the baud rate '
                f'({self.port.baud})')

    def unknown_bytes(self, now: float) -> str:
        """What the bytes are that are received, if no frame is among them; else ''."""
        return self._unknown_bytes.meaning(self.port.baud, now)

    @property
    def reconnects(self) -> int:
        """How often the port has been opened again."""
        return max(self.connections - 1, 0)

    @property
    def is_dropping(self) -> bool:
        """Whether received bytes are dropped now, after a stall."""
        return self._stall > 0

    @property
    def awake_at(self) -> float:
        """When the thread last ran, by `pace.clock`; infinite before the start."""
        return self._stalls.awake_at

    # -- for callers ------------------------------------------------------------------

    def start(self) -> None:
        """Start all threads of the link; none is started later."""
        self._opener.start()
        self._thread.start()

    def stop(self) -> None:
        """Make the link's threads end; returns at once."""
        self._opener.end()
        self.port.wake()

    def join(self, timeout: float = 1.0) -> None:
        """Wait after `stop` for the thread to close the port and end, for at most `timeout` s."""
        if self._thread.is_alive():
            self._thread.join(timeout)

    def wake(self) -> None:
        """Make the thread call `tick` soon."""
        self.port.wake()

    def may_be_from_a_stall(self) -> bool:
        """Whether what is asked for now may have waited while the bridge stalled.

        That is so during a stall, and until `AFTER_STALL` s after it. Any thread may call this: a
        caller's thread may run again before the link's thread does.
        """
        now = pace.clock()
        return self._stalls.stalled_for(now) > 0 or self._stalls.has_just_stalled(now)

    def send(self, frame: bytes, type_: int, command: int, data: bytes, message: Any) -> None:
        """Write one frame, count it and pass it to `tap`.

        Raises:
            PortError, PortBusy: nothing was written.
        """
        self.port.write(frame)
        self.written(frame, type_, command, data, message)

    def written(self, frame: bytes, type_: int, command: int, data: bytes, message: Any) -> None:
        """Count a frame that the port has taken, and pass it to `tap`."""
        self.frames_sent += 1
        tap = self.tap      # another thread may set it to None meanwhile
        if tap:
            # Guarded: an error here would look as if the frame had not been sent.
            self._guarded(lambda tap: tap(self.name, TX, Frame(
                frame, type_, command, data, message, self._clock())), tap)

    def take_chunk(self, chunk: Chunk) -> None:
        """A chunk of the board's announcement was received; called in the link's thread."""
        if self.on_announcement is None:
            return
        try:
            text = self.announcement.take(chunk)
        except ValueError as error:
            self.log.warn('announcement', str(error))
            return
        if text is not None:
            self.on_announcement(text)

    @property
    def still_announces(self) -> bool:
        """Whether the board is known to announce the rows in use.

        After the port was opened the board may be another one, or have other firmware, where the
        same bytes mean something else. So until it has announced the rows again, nothing that they
        describe is sent or published.
        """
        announcement = self.announcement
        return announcement.confirmed and announcement.text == self.text_in_use

    def holds_back(self, message: Any) -> bool:
        """Whether a received message may mean something else, since only a row describes it that
        the board is not known to announce. It is then counted, and may not be published."""
        if not message.ANNOUNCED or self.still_announces:
            return False
        self.held_back += 1
        return True

    def refuse_unless_announced(self, command: str) -> None:
        """Raise Refused for an announced command that the board may no longer have."""
        if not self.still_announces:
            raise Refused(f'{command} refused: the board has not announced it since the port was '
                          'opened, or since the board may have changed', 'not announced')

    def silent_for(self, now: float) -> float:
        """s since the latest byte; 0.0 if none was received since the port was opened."""
        return now - self.last_byte_at if self.last_byte_at > self._opened_at else 0.0

    def check_silence(self, now: float, limit: float) -> Optional[float]:
        """For `tick`: have a network port closed if it has been silent for `limit` s.

        That drops unsent bytes, which may wait unseen in the network or in the peer's kernel. A
        limit of 0 turns the check off.

        Returns:
            when to check again; None: never, since the port is not a network port or `limit` is 0.

        Raises:
            PortError: nothing was received for `limit` s.
        """
        if not limit or not self.port.is_network:
            return None
        due = self.last_byte_at + limit
        if now >= due:
            raise PortError(f'nothing received from the board for {limit:g} s')
        return due

    # -- diagnostics ------------------------------------------------------------------

    def report(self, now: float) -> Report:
        """The state of the link, with the errors since the previous call as those of the last
        second. So it has to be called once a second."""
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
        values += self.extra_values()
        if self.announced is not None:
            values += [('firmware', self.announced.firmware),
                       ('announced', ', '.join(self.announced.rows)),
                       ('held back', self.held_back)]
        return Report(level, summary, values)

    def condition(self, now: float) -> Tuple[int, str]:
        """Level and summary, without regard to new errors."""
        if not self.port.is_open:
            return ERROR, f'closed: {self._trouble or "not opened yet"}'
        if self.last_frame_at is None or now - self.last_frame_at > SILENCE:
            return WARN, f'open, {self.unknown_bytes(now) or "the board is silent"}'
        return OK, 'open'

    def error_count(self) -> int:
        """Errors of all causes so far."""
        return sum(self.decoder.errors.values())

    def extra_values(self) -> List[Tuple[str, Any]]:
        """Further keys and values of this kind of link."""
        return []

    # -- the thread -------------------------------------------------------------------

    def _run(self) -> None:
        """Run until `stop`; errors of hooks and callbacks, and a lack of memory, do not end it."""
        while not self._stopping.is_set():
            try:
                self._serve_connections()
            except BaseException:  # pylint: disable=broad-except
                time.sleep(_AFTER_FAULT)    # too little memory even to log it

    def _serve_connections(self) -> None:
        """Open the port, serve it and close it, again and again."""
        if self.port.is_open:       # an error ended the previous call
            self._close_port()
        while self._opener.open(self._not_opened, self._idle):
            self._guarded(self._serve)
            self._close_port()

    def _close_port(self) -> None:
        self.announcement.reset()      # before any thread can write to the port's next opening
        self._guarded(self.port.close)
        self._guarded(self.closed, time.monotonic())

    def _idle(self, now: float) -> float:
        self._check_awake()
        due = self._guarded(self.idle, now)
        soon = now + LONGEST_SLEEP
        return soon if due is None else min(due, soon)

    def _check_awake(self) -> float:
        """The length in s of the stall that ends now; 0.0 if there is none."""
        now = pace.clock()
        seconds = self._stalls.stalled_for(now)
        self._stalls.awake_at = now
        return seconds

    def _not_opened(self, trouble: str) -> None:
        self._trouble = trouble
        # If everything is stopped together, a simulated board's port may vanish first: no warning.
        if time.monotonic() >= self._lost_at + _SHUTDOWN_TIME:
            self._report_loss()
            self.log.warn('closed', f'{self.port.url}: {trouble}')

    def _report_loss(self) -> None:
        if self._lost:
            self.log.warn('lost', self._lost)
            self._lost = ''

    def _guarded(self, function: Callable, *arguments: Any) -> Any:
        """Call a function. If it raises, log that, report it as the link's trouble and return
        None."""
        try:
            return function(*arguments)
        except PortError as error:
            self._trouble = str(error)
            self._lost = f'{self.port.url}: {error}; opening it again when it returns'
            self._lost_at = time.monotonic()
        except BaseException as error:  # pylint: disable=broad-except
            # Also SystemExit, which would end this thread alone.
            self._trouble = f'fault in the bridge: {error!r}'
            if not self._stopping.is_set():
                self.log.error('fault', traceback.format_exc())
        return None

    def _serve(self) -> None:
        """Read until the port is lost or the link is stopped."""
        self._report_loss()
        self.connections += 1
        self.log.info('opened', f'{self.port.url}: open')
        self.decoder.reset()
        now = time.monotonic()
        self.opened(now)
        self.last_byte_at = self._opened_at = self._presence_at = look_at = now
        self._unknown_bytes.reset()
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
                self._check_port(now)
            due = timer.due(self.last_byte_at)
            if due is not None:
                wake_at = min(wake_at, due)
            data = self.port.read(wake_at - now)
            stamp = self._clock()
            now = time.monotonic()
            self.drained = not data
            stall = self._check_awake()
            if stall:
                self._begin_to_drop(stall, now)
            if self._stall and not self._stalls.has_just_stalled(self.awake_at):
                self._end_drop()
            if self._stall:
                self._drop(data, now)
                if stall and self.port.is_network and not self.HAS_FENCES:
                    raise PortError(f'the bridge stalled for {stall:.3g} s, and what waited in the '
                                    'network is old')
            elif data:
                self.take(data, stamp, now)
            if self.decoder.pending:
                self._deliver(timer.overdue(self.last_byte_at, now), now)

    def _check_port(self, now: float) -> None:
        """Check what rarely changes: the settings of the port, and whether the board talks."""
        changed = self.port.restore_settings()
        if changed:
            self.log.warn('settings', f'{self.port.url}: another program changed the settings of '
                          f'this port ({changed}). They are restored, and the bytes that waited in '
                          'it were dropped; keep other programs (stty, a serial monitor) off it')
            self.decoder.reset()
            self.altered(now)
        if now >= self._presence_at:
            self._presence_at = now + LOOK_PERIOD
            talks = self.talks(now)
            has_talked = self.last_frame_at is not None and self.last_frame_at >= self._opened_at
            if talks or has_talked or now >= self._opened_at + STARTUP_TIME:
                self._presence.update(talks, self._why_silent(now), now)

    def _why_silent(self, now: float) -> str:
        unknown = self.unknown_bytes(now)
        return self.silence() if not unknown else (
            f'{unknown} `rosrun serial_communication ports` finds out which board is on which port')

    def _begin_to_drop(self, seconds: float, now: float) -> None:
        """The thread stalled for `seconds`, or did so again soon after a stall."""
        self._stall += seconds
        self.decoder.reset()
        self.stalled(seconds, now)

    def _drop(self, data: bytes, now: float) -> None:
        """Drop the bytes of one read at the end of a stall, or shortly after it."""
        self.stale += len(data)
        self._dropped += len(data)
        if data:
            self.last_byte_at = now
        # A frame may begin in these bytes and end in the next read. If it has no checksum, its end
        # alone could be taken for another frame. So the decoder gets the beginning, too.
        errors = dict(self.decoder.errors)
        self.decoder.feed(data, _OLD)
        self.decoder.errors.update(errors)

    def _end_drop(self) -> None:
        """What is read from now on is new; log what was dropped."""
        if self._dropped:
            self.log.warn('stalled', f'the bridge stalled for {self._stall:.3g} s: {self._dropped} '
                          'bytes that waited in the port are old and were dropped')
        self._stall, self._dropped = 0.0, 0

    def take(self, data: bytes, stamp: Any, now: float) -> None:
        """Decode the bytes of one read and deliver their frames."""
        self.last_byte_at = now
        self._deliver(self.decoder.feed(data, stamp), now)
        if now - self._understood_at > SILENCE:
            self._guarded(self._unknown_bytes.take, data, now)
        elif self._unknown_bytes.size:
            self._unknown_bytes.reset()

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
                if frame.message is not None:     # another board's bytes may be an unknown frame
                    self._understood_at = now
                self.received(frame, now)
            if tap:
                self._guarded(tap, self.name, RX, shown)
