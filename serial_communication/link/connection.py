"""The connection to one board: opens, reads and closes its port, in rounds."""
import enum
import threading
import time
import traceback
from typing import TYPE_CHECKING, Any, Callable

from ..framing.frame_timer import FrameTimer
from ..transport.port import PortError
from .stall import LONGEST_SLEEP, STALL, StallWatch
from .stamps import Read

if TYPE_CHECKING:
    from .link import Link

_SHUTDOWN_TIME = 0.5    # s within which bridge and simulated boards end if stopped together
_AFTER_FAULT = 0.1      # s until the thread goes on after an unexpected error
_BACK_OFF = 0.1, 1.0    # s until the port is opened again: the first pause, the longest
_NEVER = float('inf')
_OLD = object()         # the stamp of bytes that waited during a stall


class PortState(enum.Enum):
    """What the thread does with the port."""

    CLOSED = 'open it'
    RECEIVING = 'read: more bytes may wait'
    DRAINED = 'read: all bytes that had been received are decoded'
    DROPPING = 'read, and drop what waited during a stall'


class Connection:
    """Serves one link: `step` is one round, and calls the link's hooks.

    A thread of its own does one round after the other. It sleeps in the port alone.

    Args:
        stamp: returns the stamp of a read.
    """

    def __init__(self, link: 'Link', frame_timeout: float, stamp: Callable[[], Any]) -> None:
        self.state = PortState.CLOSED
        self.trouble = 'not opened yet'    # why the port is closed, or will be
        self.number = 0                    # how often the port has been opened
        self.opened_at = 0.0
        self.last_byte_at = 0.0            # the opening counts as a byte
        self.stale = 0                     # bytes dropped because they waited during a stall
        self.stalls = StallWatch(STALL)    # of the thread
        self._link = link
        self._port = link.port
        self._now = link.now
        self._stamp = stamp
        self._timer = FrameTimer(link.decoder, frame_timeout, link.port.baud)
        self._ending = threading.Event()
        self._is_woken = False             # `wake` was called since the latest `tick`
        self._due = 0.0                    # the next round, at the latest
        self._tick_at = self._look_at = 0.0
        self._open_at = 0.0                # when to open the port
        self._pause = _BACK_OFF[0]         # s until the try after that
        self._lost = ''                    # why the port was lost; '': not lost, or already logged
        self._lost_at = 0.0                # when
        self._stalled_for = 0.0            # s; of the stall whose bytes are dropped
        self._dropped = 0                  # bytes, since that stall
        self._thread = threading.Thread(target=self._run, name=link.name + ' link', daemon=True)

    # -- for any thread; `Link` explains the first four ---------------------------------

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._ending.set()
        self._port.wake()

    def join(self, timeout: float) -> None:
        if self._thread.is_alive():
            self._thread.join(timeout)

    def wake(self) -> None:
        self._is_woken = True
        self._port.wake()

    def may_be_from_a_stall(self) -> bool:
        """Whether what is asked for now may have waited during a stall: also while the connection's
        thread does not run again yet, and until `AFTER_STALL` s later."""
        now = self._now()
        return self.stalls.stalled_for(now) > 0 or self.stalls.has_just_stalled(now)

    @property
    def reconnects(self) -> int:
        return max(self.number - 1, 0)

    # -- for the link, in the thread --------------------------------------------------

    def guarded(self, function: Callable, *arguments: Any) -> Any:
        """Call a function. If it raises, log and report that, and return None."""
        try:
            return function(*arguments)
        except PortError as error:
            self.trouble = str(error)
            self._lost = f'{self._port.url}: {error}; opening it again when it returns'
            self._lost_at = self._now()
        except BaseException as error:  # pylint: disable=broad-except
            # Also SystemExit, which would end this thread alone.
            self.trouble = f'fault in the bridge: {error!r}'
            if not self._ending.is_set():
                self._link.log.error('fault', traceback.format_exc())
        return None

    # -- rounds -----------------------------------------------------------------------

    def _run(self) -> None:
        """Errors of hooks and callbacks, and a lack of memory, do not end this."""
        while self._due < _NEVER:
            try:
                self.step()
            except BaseException:  # pylint: disable=broad-except
                time.sleep(_AFTER_FAULT)    # too little memory even to log it

    def step(self) -> float:
        """Sleep in the port until something is due or received, and do it; return when the next
        round is due."""
        if self._ending.is_set():
            if self._port.is_open:
                self._close()
            self._due = _NEVER
        elif not self._port.is_open:
            self._due = self._closed_round()
        elif self.state is PortState.CLOSED:
            self._due = self.guarded(self._begin) or self._close()
        else:
            self._due = self.guarded(self._open_round) or self._close()
        return self._due

    # -- opening and closing ----------------------------------------------------------

    def _closed_round(self) -> float:
        self._port.pause(self._due - self._now())
        now = self._now()
        self._stalled_for += self.stalls.stalled_for(now)     # the port may just be opened
        self.stalls.awake_at = now
        due = self.guarded(self._link.idle, now)
        self._link.lending.step()
        if now >= self._open_at and not self._ending.is_set():
            self._try_to_open(now)
        due = min(self._open_at, now + LONGEST_SLEEP, now + LONGEST_SLEEP if due is None else due)
        return now if self._port.is_open else due

    def _try_to_open(self, now: float) -> None:
        trouble = ''
        try:
            self._port.open()
        except PortError as error:
            trouble = str(error)
        except BaseException as error:  # pylint: disable=broad-except
            trouble = f'fault while opening it: {error!r}'
        after = self._now()
        if after - now > STALL:     # the bridge may have stalled: drop what waits in the port
            self._stalled_for += after - now
        self.stalls.awake_at = after
        if not trouble:
            self._pause = _BACK_OFF[0]
            return
        self._port.close()
        self._open_at = after + self._pause
        self._pause = min(self._pause * 2, _BACK_OFF[1])
        self.trouble = trouble
        # If everything is stopped together, a simulated board's port may vanish first: no warning.
        if after >= self._lost_at + _SHUTDOWN_TIME and not self._ending.is_set():
            self._log_loss()
            self._link.log.warn('closed', f'{self._port.url}: {trouble}')

    def _close(self) -> float:
        self.state = PortState.CLOSED
        self._link.announcement.reset()    # before any thread can write to the next opening
        self.guarded(self._port.close)
        self.guarded(self._link.board_settings.closed)
        self._open_at = self._now()
        self.guarded(self._link.closed, self._open_at)
        return self._open_at

    def _log_loss(self) -> None:
        if self._lost:
            self._link.log.warn('lost', self._lost)
            self._lost = ''

    def _begin(self) -> float:
        """The port was opened; return the time."""
        link = self._link
        self._log_loss()
        self.trouble = 'the bridge is stopping'
        self.number += 1
        link.log.info('opened', f'{self._port.url}: open')
        link.decoder.reset()
        link.stamps.reset()
        link.board_settings.reset()
        link.presence.opened()
        self._timer.reset()
        now = self._now()
        link.opened(now)
        self.last_byte_at = self.opened_at = self._tick_at = self._look_at = now
        # What waited during a stall may arrive over a new connection, too.
        self.state = PortState.DROPPING if self._stalled_for else PortState.RECEIVING
        return now

    # -- reading ----------------------------------------------------------------------

    def _open_round(self) -> float:
        link = self._link
        data = self._port.read(self._due - self._now())
        # The clock after that: what it takes to make its stamp varies, and is not in `now`.
        now = self._now()
        stamp = self._stamp()
        stall = self._check_stall(now)
        if self.state is PortState.DROPPING:
            self._drop(data, stall, now)
        else:
            self._receive(data, stamp, now)
        if not data or self._is_woken or now >= self._tick_at:
            self._is_woken = False
            due = link.tick(now)
            link.lending.step()
            self._tick_at = now + LONGEST_SLEEP if due is None else min(due, now + LONGEST_SLEEP)
        if now >= self._look_at:
            self._look_at = now + LONGEST_SLEEP
            self._restore_settings(now)
            link.check(now)
        if link.DRAINS and self.state is PortState.RECEIVING:
            return now
        frame_due = self._timer.due(self.last_byte_at)
        return self._tick_at if frame_due is None else min(self._tick_at, frame_due)

    def _restore_settings(self, now: float) -> None:
        changed = self._port.restore_settings()
        if changed:
            self._link.log.warn(
                'settings', f'{self._port.url}: another program changed the settings of this port '
                f'({changed}). They are restored, and the bytes that waited in it were dropped; '
                'keep other programs (stty, a serial monitor) off it')
            self._link.decoder.reset()
            self._link.altered(now)

    def _receive(self, data: bytes, stamp: Any, now: float) -> None:
        link = self._link
        if data:
            self.last_byte_at = now
            link.presence.bytes_came(now)
        frames = link.decoder.feed(data, Read(stamp, now)) if data else []
        if link.decoder.pending:
            frames += self._timer.overdue(self.last_byte_at, now)
        self.state = PortState.RECEIVING if data or frames else PortState.DRAINED
        for frame in frames:
            if frame.stamp is not _OLD:
                link.deliver(frame, now)

    def _check_stall(self, now: float) -> float:
        """After a stall begin to drop, and return its length in s; end that when bytes are new."""
        link = self._link
        seconds = self.stalls.stalled_for(now)
        self.stalls.awake_at = now
        if seconds:
            self.state = PortState.DROPPING
            self._stalled_for += seconds
            link.decoder.reset()
            link.stamps.reset()
            link.stalled(seconds, now)
        elif self.state is PortState.DROPPING and not self.stalls.has_just_stalled(now):
            if self._dropped:
                link.log.warn('stalled', f'the bridge stalled for {self._stalled_for:.3g} s: '
                              f'{self._dropped} bytes that waited in the port are old and were '
                              'dropped')
            self._stalled_for, self._dropped = 0.0, 0
            self.state = PortState.RECEIVING
        return seconds

    def _drop(self, data: bytes, stall: float, now: float) -> None:
        decoder = self._link.decoder
        self.stale += len(data)
        self._dropped += len(data)
        # A frame may begin in these bytes and end in the next read. If it has no checksum, its end
        # alone could be taken for another frame. So the decoder gets the beginning, too.
        errors = dict(decoder.errors)
        if data:
            self.last_byte_at = now
            decoder.feed(data, _OLD)
        self._timer.overdue(self.last_byte_at, now)
        decoder.errors.update(errors)
        if stall and self._port.is_network and not self._link.HAS_FENCES:
            raise PortError(f'the bridge stalled for {stall:.3g} s, and what waited in the network '
                            'is old')
