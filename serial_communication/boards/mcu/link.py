"""The link to the sensor board: counts what was lost, and notices when the board falls silent."""
import time
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Tuple

from ...framing.stream import CHECKSUM, Frame
from ...link.link import OK, WARN, Link
from ...transport.port import Port
from . import wire

_STATUS_PERIOD = 1.0   # s from one report of silence to the next
_DOUBLED = 0.01        # s in which the same bytes again are one frame that the line has doubled


class _Heard(NamedTuple):
    """The latest message of one class."""

    seq: int
    at: float      # when it came
    due: float     # when its absence is to be reported


class McuLink(Link):
    """Frames up, nothing down.

    Args:
        timeout: seconds without a valid frame after which the board counts as silent.
        network_silence: seconds without a byte after which a network port is opened anew;
            0: never.
        messages: classes of custom messages.
        on_status: is called with each (message, seq, stamp).
        on_silence: is called once a second for each class of message that the board has sent
            and sends no more, or with None while it has never spoken; with its last seq and the
            seconds since that message (or since the start).
        link_arguments: frame_timeout, clock and logger, as `Link` has them.
    """

    def __init__(self, port: Port, timeout: float = 1.0,
                 on_status: Optional[Callable[[Any, int, Any], None]] = None,
                 on_silence: Optional[Callable[[Optional[type], int, float], None]] = None,
                 network_silence: float = 5.0, messages: Iterable[Any] = (),
                 **link_arguments) -> None:
        super().__init__('mcu', port, wire.Decoder(messages), **link_arguments)
        self.frames_lost = 0
        self.duplicates = 0
        self.checksum_errors = 0   # up to the latest frame, in whatever pieces bytes are read
        self.silent = True                      # no message of any class
        self._timeout = timeout
        self._network_silence = network_silence
        self._on_status = on_status
        self._on_silence = on_silence
        self._last: Optional[Frame] = None      # since the port opened …
        self._last_at = 0.0                     # … and when it came
        now = time.monotonic()
        self._heard: Dict[Optional[type], _Heard] = {None: _Heard(0, now, now + timeout)}

    def opened(self, now: float) -> None:
        self._last = None

    def received(self, frame: Frame, now: float) -> None:
        last, self._last = self._last, frame
        if last is not None:
            if last.raw == frame.raw:
                if now < self._last_at + _DOUBLED:
                    self.duplicates += 1
                    return
            else:
                self.frames_lost += (frame.command - last.command - 1) % 256
        self._last_at = now
        if frame.message is None:     # valid, but of a type nobody knows
            return
        if self.silent:
            self.silent = False
            self._heard.pop(None, None)
        self._heard[type(frame.message)] = _Heard(frame.command, now, now + self._timeout)
        if self._on_status:
            self._on_status(frame.message, frame.command, frame.stamp)

    def damaged(self, frame: Frame, now: float) -> None:
        self.checksum_errors += frame.cause == CHECKSUM

    def tick(self, now: float) -> float:
        due = self.idle(now)
        look = self.check_silence(now, self._network_silence)
        return due if look is None else min(due, look)

    def idle(self, now: float) -> float:
        for kind, (seq, at, due) in self._heard.items():
            if now >= due:
                self._heard[kind] = _Heard(seq, at, max(due + _STATUS_PERIOD, now))
                self._miss(now)
                if self._on_silence:
                    self._on_silence(kind, seq, now - at)
        return min(heard.due for heard in self._heard.values())

    def _miss(self, now: float) -> None:
        if not self.silent and all(now >= heard.at + self._timeout
                                   for heard in self._heard.values()):
            self.silent = True

    def condition(self, now: float) -> Tuple[int, str]:
        if not self.port.is_open:
            return super().condition(now)
        return (WARN, 'open, the board is silent') if self.silent else (OK, 'open')

    def talks(self, now: float) -> Optional[bool]:
        return not self.silent

    def extra_values(self) -> List[Tuple[str, Any]]:
        return [('frames lost', self.frames_lost), ('frames doubled', self.duplicates)]
