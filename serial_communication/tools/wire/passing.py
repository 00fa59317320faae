"""One direction through a tap: bytes are passed on at once or not at all."""
from typing import Callable

from ...boards.arduino import wire as arduino
from ...transport.port import Port, PortBusy, PortError
from .lines import Settings

_STALLED = 0.05   # s of wire time that wait in a port beside what was handed over last
_OLD = 0.3        # s that any byte may wait there
_PAUSE = 2.0      # of frame_timeout: how long nothing is passed on after bytes were lost
_QUIET = 0.02     # s without a byte after which a frame begins; an adapter holds bytes for 16 ms
_LONGEST = 1030   # bytes of the longest frame of any link
_SILENCE = 1.0    # s; as the bridge's arduino/network_silence
_CALIBRATED = 2.0    # s of silence that end with a calibration, as a link has it
_END = b'\0'      # of a packet
_CALIBRATION = _END + arduino.encode(arduino.ImuCalibration())
_SPEED_0 = arduino.encode(arduino.SpeedCommand(0))


class Passage:
    """Hands what one end says over to the port of the other end; never waits, keeps nothing.

    The rule of the bridge's own links holds: where 50 ms of wire time wait in the port, it does not
    flow. What waits is then dropped, since a command must not reach a motor seconds later; fewer
    bytes likewise after 0.3 s. After any loss:

    - Nothing is passed on for twice the frame timeout: the receiver gives up what was cut off.
    - It goes on where a frame begins: behind the 0x00 that ends a packet, or behind a silence.
    - On the link arduino a 0x00 goes first, which ends what was cut off, and to the board SPEED 0
      behind it: the board may still hold a speed whose stop was lost.

    Args:
        port: of the other end; opened, read and closed elsewhere.
        sent: whether the bytes are sent to the board.
        tell: is called with what people are to know.
    """

    def __init__(self, port: Port, line: Settings, sent: bool, tell: Callable[[str], None]) -> None:
        self.lost = 0               # bytes that did not reach the other end
        self._port = port
        self._is_cobs = line.link == 'arduino'
        self._lead = (_END + _SPEED_0 if sent else _END) if self._is_cobs else b''
        self._pause = line.frame_timeout * _PAUSE
        self.remedy = '; SPEED 0 goes first when it goes on' if sent and self._is_cobs else ''
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
        self._last_byte = _END      # of this direction …
        self._last_at = float('-inf')       # … and when it came
        self._unanswered_since = 0.0        # of what was handed over, until the board is heard
        self._calibrating = False

    def pass_on(self, data: bytes, now: float) -> None:
        """Hand over what was read just now; to be called without bytes, too, every 50 ms."""
        if self._broken:
            self._broken = False
            self._lose(0, now)
        self._look_after(now)
        if not data:
            return
        begin = self._begin(data, now)
        self._last_byte, self._last_at = data[-1:], now
        self.lost += begin
        data = data[begin:]
        if data:
            self._write(data, now)

    def interrupted(self, count: int, now: float) -> None:
        """So many bytes of this direction were dropped before they came here."""
        self._lose(count, now)
        self._last_byte, self._last_at = b'', now

    def broken(self) -> None:
        """The port has been closed, and what was handed to it may not have left."""
        self._broken = self._handed > 0

    def heard(self, now: float, before: float) -> None:
        """The other end has said something now, and `before` that."""
        self._unanswered_since = 0.0
        if now - before >= _CALIBRATED:
            self._calibrating = False

    def is_unanswered(self, now: float) -> bool:
        """Whether a board behind a network has been silent for so long since it was sent something
        that this may wait on the way, where nobody sees it."""
        return (self._is_cobs and self._port.is_network and not self._calibrating
                and 0.0 < self._unanswered_since <= now - _SILENCE)

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
        self._calibrating = self._calibrating or _CALIBRATION in _END + data

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
        if (now - self._last_at >= _QUIET or (self._is_cobs and self._last_byte == _END)
                or self._skipped > _LONGEST):     # no such line: any place is as good
            return 0
        return data.find(_END) + 1 or len(data) if self._is_cobs else len(data)
