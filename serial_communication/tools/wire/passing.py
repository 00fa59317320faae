"""One direction through a tap: bytes are passed on at once or not at all."""
from typing import Callable

from ...transport.port import Port, PortBusy, PortError
from .lines import Settings, decoder

_STALLED = 0.05   # s of wire time that wait in a port beside what was handed over last
_OLD = 0.3        # s that any byte may wait there
_PAUSE = 2.0      # of frame_timeout: how long nothing is passed on after bytes were lost
_QUIET = 0.02     # s without a byte after which a frame begins; an adapter holds bytes for 16 ms
_LONGEST = 1030   # bytes of the longest frame of any link
_LONG_SILENCE = 2.0     # s that a silence takes at least which the board was told to keep


class Passage:
    """Hands what one end says over to the port of the other end; never waits, keeps nothing.

    The rule of the bridge's own links holds: where 50 ms of wire time wait in the port, it does not
    flow. What waits is then dropped, since a command must not reach a motor seconds later; fewer
    bytes likewise after 0.3 s. After any loss:

    - Nothing is passed on for twice the frame timeout: the receiver gives up what was cut off.
    - It goes on where a frame begins: behind a byte that ends one, or behind a silence.
    - What ends a frame goes first, for what was cut off; to the board what its description has for
      this: it may still hold a speed whose stop was lost.

    Args:
        port: of the other end; opened, read and closed elsewhere.
        sent: whether the bytes are sent to the board.
        tell: is called with what people are to know.
    """

    def __init__(self, port: Port, line: Settings, sent: bool, tell: Callable[[str], None]) -> None:
        self.lost = 0               # bytes that did not reach the other end
        self._port = port
        self._board = line.board
        self._other_end = 'board' if sent else 'computer'
        self._lead = line.board.first_after_loss if sent else line.board.between
        self._pause = line.frame_timeout * _PAUSE
        first = [frame.text for frame in decoder(line, True).feed(self._lead)] if sent else []
        self.remedy = f'; {" and ".join(first)} goes first when it goes on' if first else ''
        self._tell = tell
        self._handed = 0            # bytes, to the port
        self._latest = 0.0          # s of wire time that were handed over last
        self._mark = 0              # so many of them are to have left …
        self._mark_due = 0.0        # … by then
        self._broken = False        # set by the thread that reads the port
        self._cut_off = False       # bytes were lost since the latest that were passed on …
        self._resume_at = 0.0       # … nothing is passed on before …
        self._skipped = 0           # … and so many bytes were in the search for a frame
        self._told_lost = -1        # `lost` as a loss was told; -1: nothing is to be told
        self._lost_from = 0         # `_handed` at the latest loss
        self._has_ended = True      # the last byte of this direction ended a frame …
        self._last_at = float('-inf')       # … and when it came
        self._unanswered_since = 0.0        # of what was handed over, until the board is heard
        self._heard_at = 0.0
        self._may_be_silent = False         # it was told something that makes it so

    def pass_on(self, data: bytes, now: float) -> None:
        """Hand over what was read just now; to be called without bytes, too, every 50 ms."""
        if self._broken:
            self._broken = False
            self._lose(0, now)
        self._look_after(now)
        if not data:
            return
        begin = self._begin(data, now)
        self._has_ended, self._last_at = data[-1] in self._board.between, now
        self.lost += begin
        data = data[begin:]
        if data:
            self._write(data, now)

    def interrupted(self, count: int, now: float) -> None:
        """So many bytes of this direction were dropped before they came here."""
        self._lose(count, now)
        self._has_ended, self._last_at = False, now

    def broken(self) -> None:
        """The port has been closed, and what was handed to it may not have left."""
        self._broken = self._handed > 0

    def listens(self, now: float) -> None:
        """From now on the other end can be heard: what was before is no silence of its own."""
        self._heard_at, self._unanswered_since = now, 0.0

    def look_at_silence(self, heard: bool, now: float) -> None:
        """To be called after each read of the other end, with whether it said something. Behind a
        network, what it was sent may wait where nobody sees it.

        Raises:
            PortError: it has been silent for too long since it was sent something.
        """
        limit = self._board.network_silence
        if heard:
            if now - self._heard_at >= _LONG_SILENCE:
                self._may_be_silent = False
            self.listens(now)
        elif (limit and self._port.is_network and not self._may_be_silent
                and 0.0 < self._unanswered_since <= now - limit):
            raise PortError(f'the {self._other_end} has not been heard for {limit:g} s')

    # -- handing over -----------------------------------------------------------------------

    def _write(self, data: bytes, now: float) -> None:
        try:
            self._port.write(self._lead + data if self._cut_off else data)
        except PortBusy:
            self._unblock(now)
            self.lost += len(data)
            return
        except PortError as error:
            self._tell_once(f'not passed on to {self._port.url}: {error}{self.remedy}')
            self._lose(len(data), now)
            return
        self._handed += len(data)
        self._latest = len(data) * 10.0 / self._port.baud
        self._cut_off = False
        self._unanswered_since = self._unanswered_since or now
        between, silencing = self._board.between, self._board.silent_after
        if silencing and between + silencing in between + data:
            self._may_be_silent = True

    def _look_after(self, now: float) -> None:
        """Has what was handed over left the port in time?"""
        waiting = self._port.backlog()
        left = self._handed - self._bytes_in(waiting)
        if waiting > _STALLED + self._latest:
            self._unblock(now)
        elif left >= self._mark:
            self._mark, self._mark_due = self._handed, now + _OLD
            if self._told_lost >= 0 and left > self._lost_from:
                self._tell(f'{self._port.url} takes bytes again; {self.lost - self._told_lost} '
                           'were lost')
                self._told_lost = -1
        elif now > self._mark_due:
            self._unblock(now)

    def _bytes_in(self, seconds: float) -> int:
        return round(seconds * self._port.baud / 10)

    # -- losses -----------------------------------------------------------------------------

    def _unblock(self, now: float) -> None:
        """Drop what waits in the port: it would reach the other end late."""
        waiting = self._bytes_in(self._port.backlog())
        dropped = self._port.discard_output()
        self._tell_once(f'not passed on to {self._port.url}: it takes no data; ' + (
            'what waited is dropped' if dropped else 'the connection is broken off')
                        + self.remedy)
        self._lose(waiting, now)

    def _tell_once(self, text: str) -> None:
        """Unless it was told, and the port has not taken anything since."""
        if self._told_lost < 0:
            self._told_lost = self.lost
            self._tell(text)

    def _lose(self, count: int, now: float) -> None:
        self.lost += count
        self._cut_off = True
        self._skipped = 0
        self._resume_at = now + self._pause
        self._mark = self._lost_from = self._handed

    def _begin(self, data: bytes, now: float) -> int:
        """From where on these bytes may be passed on; all of them but after a loss."""
        if not self._cut_off:
            return 0
        if now < self._resume_at:
            return len(data)
        self._skipped += len(data)
        if (now - self._last_at >= _QUIET or self._has_ended
                or self._skipped > _LONGEST):     # no such line: any place is as good
            return 0
        return next((at for at, byte in enumerate(data, 1) if byte in self._board.between),
                    len(data))
