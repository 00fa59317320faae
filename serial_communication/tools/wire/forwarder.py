"""One direction through a tap: bytes are forwarded at once or dropped."""
from typing import Callable

from ...transport.port import Port, PortBusy, PortError
from .lines import Settings, decoder

_MOST_BACKLOG = 0.05   # s of wire time that may wait in a port besides the last write
_MOST_AGE = 0.3        # s that a byte may wait there
_PAUSE = 2.0           # in frame_timeouts: nothing is forwarded for so long after a loss
_QUIET = 0.02          # s; a byte after such a silence begins a frame (adapters hold back 16 ms)
_LONGEST = 1030        # bytes of the longest frame of any link
_ANNOUNCED_SILENCE = 2.0    # s; a silence that the computer asked for lasts at least this long


class Forwarder:
    """Writes the bytes of one end to the port of the other end. Never waits and keeps nothing.

    The same rule as for the bridge's links: a port with a backlog of 50 ms of wire time is blocked.
    The backlog is then dropped, since a command must not reach a motor seconds later. A smaller
    backlog is dropped after 0.3 s. After any loss:

    - Nothing is forwarded for twice the frame timeout, so that the receiver drops an incomplete
      frame.
    - Forwarding resumes where a frame begins: after a byte that ends one, or after a silence.
    - To the computer, a byte that ends a frame is sent first. To the board,
      `Description.first_after_loss` is: the board may still hold a speed whose stop was lost.

    Args:
        port: the port of the other end, which is opened, read and closed elsewhere.
        sent: whether the bytes are sent to the board.
        report: is called with one line for the user.
    """

    def __init__(self, port: Port, line: Settings, sent: bool,
                 report: Callable[[str], None]) -> None:
        self.lost = 0               # bytes that did not reach the other end
        self._port = port
        self._board = line.board
        self._other_end = 'board' if sent else 'computer'
        self._resync = line.board.first_after_loss if sent else line.board.between
        self._pause = line.frame_timeout * _PAUSE
        first = [frame.text for frame in decoder(line, True).feed(self._resync)] if sent else []
        self.remedy = f'; {" and ".join(first)} is sent first afterwards' if first else ''
        self._report = report
        self._written = 0               # bytes written to the port
        self._last_write = 0.0          # s of wire time
        self._checkpoint = 0            # so many of the bytes written must have left the port …
        self._checkpoint_due = 0.0      # … by this time
        self._port_closed = False       # set by the thread that reads the port
        self._cut_off = False           # bytes were lost since the last write …
        self._resume_at = 0.0           # … nothing is forwarded before this time …
        self._skipped = 0               # … bytes received since then, without the start of a frame
        self._reported_lost = -1        # `lost` when the loss was reported; -1: none to report
        self._written_at_loss = 0       # `_written` at the latest loss
        self._frame_ended = True        # the last byte of this direction ended a frame …
        self._last_at = float('-inf')   # … and was received at this time
        self._unanswered_since = 0.0    # the first write that the other end has not answered
        self._received_at = 0.0         # from the other end
        self._silence_announced = False    # the board was sent a frame after which it is silent

    def forward(self, data: bytes, now: float) -> None:
        """Write what was just read. To be called at least every 50 ms, without bytes too."""
        if self._port_closed:
            self._port_closed = False
            self._record_loss(0, now)
        self._check_backlog(now)
        if not data:
            return
        begin = self._resume_offset(data, now)
        self._frame_ended, self._last_at = data[-1] in self._board.between, now
        self.lost += begin
        data = data[begin:]
        if data:
            self._write(data, now)

    def input_dropped(self, count: int, now: float) -> None:
        """Record that `count` bytes of this direction were dropped before `forward`."""
        self._record_loss(count, now)
        self._frame_ended, self._last_at = False, now

    def port_closed(self) -> None:
        """Record that the port was closed, with bytes that may not have left it."""
        self._port_closed = self._written > 0

    def start_silence_check(self, now: float) -> None:
        """Count the silence of the other end from `now`: before that nothing could be received."""
        self._received_at, self._unanswered_since = now, 0.0

    def check_silence(self, received: bool, now: float) -> None:
        """To be called after each read of the other end. `received`: whether it had bytes.

        Behind a network port, bytes for the other end may wait in buffers that cannot be seen.

        Raises:
            PortError: the other end has been silent for too long after it was sent something.
        """
        limit = self._board.network_silence
        if received:
            if now - self._received_at >= _ANNOUNCED_SILENCE:
                self._silence_announced = False
            self.start_silence_check(now)
        elif (limit and self._port.is_network and not self._silence_announced
                and 0.0 < self._unanswered_since <= now - limit):
            raise PortError(f'nothing received from the {self._other_end} for {limit:g} s')

    # -- writing ----------------------------------------------------------------------------

    def _write(self, data: bytes, now: float) -> None:
        try:
            self._port.write(self._resync + data if self._cut_off else data)
        except PortBusy:
            self._drop_backlog(now)
            self.lost += len(data)
            return
        except PortError as error:
            self._report_once(f'not forwarded to {self._port.url}: {error}{self.remedy}')
            self._record_loss(len(data), now)
            return
        self._written += len(data)
        self._last_write = len(data) * 10.0 / self._port.baud
        self._cut_off = False
        self._unanswered_since = self._unanswered_since or now
        between, silencing = self._board.between, self._board.silent_after
        if silencing and between + silencing in between + data:
            self._silence_announced = True

    def _check_backlog(self, now: float) -> None:
        """Drop the backlog if the bytes written have not left the port in time."""
        waiting = self._port.backlog()
        left = self._written - self._bytes_in(waiting)
        if waiting > _MOST_BACKLOG + self._last_write:
            self._drop_backlog(now)
        elif left >= self._checkpoint:
            self._checkpoint, self._checkpoint_due = self._written, now + _MOST_AGE
            if self._reported_lost >= 0 and left > self._written_at_loss:
                self._report(f'{self._port.url} takes bytes again; '
                             f'{self.lost - self._reported_lost} were lost')
                self._reported_lost = -1
        elif now > self._checkpoint_due:
            self._drop_backlog(now)

    def _bytes_in(self, seconds: float) -> int:
        return round(seconds * self._port.baud / 10)

    # -- losses -----------------------------------------------------------------------------

    def _drop_backlog(self, now: float) -> None:
        """Drop what waits in the port, since it would arrive late."""
        waiting = self._bytes_in(self._port.backlog())
        dropped = self._port.discard_output()
        self._report_once(f'not forwarded to {self._port.url}: the port takes no data; ' + (
            'what waited in it was dropped' if dropped else 'the connection was closed')
                          + self.remedy)
        self._record_loss(waiting, now)

    def _report_once(self, text: str) -> None:
        """Report the first loss only, until the port takes bytes again."""
        if self._reported_lost < 0:
            self._reported_lost = self.lost
            self._report(text)

    def _record_loss(self, count: int, now: float) -> None:
        self.lost += count
        self._cut_off = True
        self._skipped = 0
        self._resume_at = now + self._pause
        self._checkpoint = self._written_at_loss = self._written

    def _resume_offset(self, data: bytes, now: float) -> int:
        """Where in `data` forwarding may resume; 0 unless bytes were lost."""
        if not self._cut_off:
            return 0
        if now < self._resume_at:
            return len(data)
        self._skipped += len(data)
        if (now - self._last_at >= _QUIET or self._frame_ended
                or self._skipped > _LONGEST):     # the line has no silences: resume anywhere
            return 0
        return next((at for at, byte in enumerate(data, 1) if byte in self._board.between),
                    len(data))
