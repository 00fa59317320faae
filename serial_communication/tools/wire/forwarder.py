"""One direction through a tap: bytes are forwarded at once or dropped."""
from typing import Callable

from ...transport.output_watch import LONGEST_WAIT, OutputWatch
from ...transport.port import Port, PortBusy, PortError
from .lines import Settings, decoder

_PAUSE = 2.0           # in frame_timeouts: nothing is forwarded for so long after a loss
_QUIET = 0.02          # s; a byte after such a silence begins a frame (adapters hold back 16 ms)
_ANYWHERE = 1.0        # s after the pause, from which forwarding may resume inside a frame
_REPORTED = float('inf')


class Forwarder:
    """Writes the bytes of one end to the port of the other end. Never waits and keeps nothing.

    Bytes that do not leave the port within 0.3 s are dropped, since a command must not reach a
    motor seconds later. After any loss:

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
        self._first = line.board.first_after_loss if sent else line.board.between
        self._pause = line.frame_timeout * _PAUSE
        first = [frame.text for frame in decoder(line, True).feed(self._first)] if sent else []
        self.remedy = f'; {" and ".join(first)} is sent first afterwards' if first else ''
        self._report = report
        self._watch = OutputWatch(port)
        self._port_closed = False       # set by the thread that reads the port
        self._cut_off = False           # bytes were lost since the last write
        self._resume_at = 0.0           # after a loss, nothing is forwarded before this time
        self._lost_before = -1          # `lost` before the loss that was reported; -1: none was
        self._frame_ended = True        # whether the last byte of this direction did
        self._last_at = float('-inf')   # when that byte was received
        # The first write since the other end was heard; 0: none; _REPORTED until it is heard.
        self._unanswered_since = 0.0

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
        if data[begin:]:
            self._write(data[begin:], now)

    def input_dropped(self, count: int, now: float) -> None:
        """Record that `count` bytes of this direction were dropped before `forward`."""
        self._record_loss(count, now)
        self._frame_ended, self._last_at = False, now

    def port_closed(self) -> None:
        """Record that the port was closed, with bytes that may not have left it."""
        self._port_closed = self._watch.written > 0

    def restart_silence_check(self) -> None:
        """Count a silence of the other end from now on: it was not read for a while."""
        if self._unanswered_since != _REPORTED:
            self._unanswered_since = 0.0

    def check_silence(self, received: bool, now: float) -> None:
        """To be called after each read of the other end. `received`: whether it had bytes.

        Behind a network port, bytes for the other end may wait in buffers that cannot be seen.

        Raises:
            PortError: the other end has been silent for too long after it was sent something. This
                is raised once for each silence, since the board may be silent for minutes.
        """
        limit = self._board.network_silence
        if received:
            self._unanswered_since = 0.0
        elif limit and self._port.is_network and 0.0 < self._unanswered_since <= now - limit:
            self._unanswered_since = _REPORTED
            raise PortError(f'nothing received from the {self._other_end} for {limit:g} s')

    # -- writing ----------------------------------------------------------------------------

    def _write(self, data: bytes, now: float) -> None:
        try:
            self._port.write(self._first + data if self._cut_off else data)
        except PortBusy:
            self._drop_backlog(now)
            self.lost += len(data)
            return
        except PortError as error:
            self._report_once(f'not forwarded to {self._port.url}: {error}{self.remedy}')
            self._record_loss(len(data), now)
            return
        self._watch.written += len(data)
        self._cut_off = False
        self._unanswered_since = self._unanswered_since or now

    def _check_backlog(self, now: float) -> None:
        """Drop the backlog if the bytes written have not left the port in time."""
        seconds = self._watch.waiting_for(now)
        if seconds > LONGEST_WAIT:
            self._drop_backlog(now)
        elif not seconds and self._watch.has_sent and self._lost_before >= 0:
            self._report(f'{self._port.url} takes bytes again; '
                         f'{self.lost - self._lost_before} were lost')
            self._lost_before = -1

    # -- losses -----------------------------------------------------------------------------

    def _drop_backlog(self, now: float) -> None:
        """Drop what waits in the port, since it would arrive late."""
        waiting, dropped = self._watch.waiting, self._port.discard_output()
        self._report_once(f'not forwarded to {self._port.url}: the port takes no data; ' + (
            'what waited in it was dropped' if dropped else 'the connection was closed')
                          + self.remedy)
        self._record_loss(waiting, now)

    def _report_once(self, text: str) -> None:
        """Report the first loss only, until the port takes bytes again."""
        if self._lost_before < 0:
            self._lost_before = self.lost
            self._report(text)

    def _record_loss(self, count: int, now: float) -> None:
        self.lost += count
        self._cut_off = True
        self._resume_at = now + self._pause
        self._watch.restart(now)

    def _resume_offset(self, data: bytes, now: float) -> int:
        """Where in `data` forwarding may resume; 0 unless bytes were lost."""
        if not self._cut_off:
            return 0
        if now < self._resume_at:
            return len(data)
        if (now - self._last_at >= _QUIET or self._frame_ended
                or now > self._resume_at + _ANYWHERE):     # the line has no silences
            return 0
        return next((at for at, byte in enumerate(data, 1) if byte in self._board.between),
                    len(data))
