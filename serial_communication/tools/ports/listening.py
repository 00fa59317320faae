"""Listens to a port and finds out which board is on it."""
import re
import time
from typing import Any, Callable, Iterable, List, Mapping, NamedTuple, Optional

from ...boards.description import Description
from ...framing.stream import UNKNOWN, Decoder, Frame
from ...transport.port import Port, PortBusy, PortError

USUAL = (9600, 57600, 38400, 19200, 230400, 460800, 921600, 500000, 250000, 1000000)    # baud
_STARTUP = 2.0    # s more for a silent port: opening it may have reset its board
_OTHER = 0.7      # s that is enough to recognise a board at another rate, at most
_ANSWER = 0.3     # s for an answer
_QUESTIONS = 3    # times that a question is asked
_SAMPLE = 24      # bytes
_FRAMES = 3       # the fewest valid frames by which a board is recognised


class Candidate(NamedTuple):
    """A board that may be on a port."""

    board: Description
    parameters: Mapping[str, Any]     # the board's, as the bridge has them

    def decoder(self) -> Decoder:
        """A decoder of what the board sends."""
        return self.board.decoder(False, self.parameters)

    @property
    def baud(self) -> int:
        """The rate at which the bridge opens its port."""
        return self.board.baud_of(self.parameters)


class Received(NamedTuple):
    """What was received on a port."""

    board: str = ''                # '': none is recognised
    baud: Optional[int] = None     # at which its frames are valid
    size: int = 0                  # bytes received at the first rate
    sample: bytes = b''            # the first of them
    trouble: str = ''              # why the port cannot be listened to

    @property
    def kind(self) -> str:
        """'frames', 'noise' or 'nothing'."""
        return 'frames' if self.board else 'noise' if self.size else 'nothing'


class Listener:
    """Listens to one port after another.

    Args:
        candidates: the boards to recognise.
        seconds: s to listen to a port.
        ask: whether boards that send only when they are asked are asked, on silent ports.
    """

    def __init__(self, candidates: Iterable[Candidate], seconds: float, ask: bool) -> None:
        self._candidates = list(candidates)
        self._seconds = seconds
        self._ask = ask

    def listen(self, url: str) -> Received:
        """What is received on a port. Nothing is written, but for questions to a silent one."""
        try:
            return self._listen(url)
        except PortError as error:
            return Received(trouble=re.sub('; (waiting|`rosrun).*', '', str(error)))

    def _listen(self, url: str) -> Received:
        rates = list(dict.fromkeys(each.baud for each in self._candidates))
        usual = [*(each.board.baud for each in self._candidates), *USUAL]
        first = Received()
        for index, baud in enumerate(dict.fromkeys([*rates, *usual])):
            seconds = self._seconds if baud in rates else min(self._seconds, _OTHER)
            heard = self._at(url, baud, seconds, wait=not index)
            first = first if index else heard
            if heard.board:
                return heard._replace(size=first.size or heard.size)
            if not first.size and baud == rates[-1]:
                break     # silent at every rate that a bridge would use
        return first if first.size or not self._ask else self._asked(url) or first

    def _at(self, url: str, baud: int, seconds: float, wait: bool) -> Received:
        """Listen at one rate, until a board is recognised.

        Args:
            wait: listen longer if nothing is received.
        """
        heard, name, look_at = b'', '', 0

        def received(data: bytes) -> bool:
            nonlocal heard, name, look_at
            heard += data
            if len(heard) >= look_at:
                name, look_at = recognised(self._candidates, heard), 2 * len(heard)
            return bool(name)

        port = Port(url, baud)
        try:
            port.open()
            _read(port, seconds, received)
            if wait and not heard:
                _read(port, _STARTUP, received)
        finally:
            port.close()
        name = name or recognised(self._candidates, heard)
        return Received(name, baud if name else None, len(heard), heard[:_SAMPLE])

    def _asked(self, url: str) -> Optional[Received]:
        """The board that answers its question; None: no board does."""
        for each in self._candidates:
            if each.board.question:
                answer = _answer(url, each)
                if answer:
                    return Received(each.board.name, each.baud, len(answer), answer[:_SAMPLE])
        return None


def recognised(candidates: Iterable[Candidate], data: bytes) -> str:
    """The name of the board whose frames these bytes are, or ''.

    Bytes of another board, of another baud rate or of noise are sometimes a valid frame by chance,
    above all without a checksum. So it needs several valid ones that have most of the bytes.
    """
    name, most = '', 0
    for each in candidates:
        decoder = each.decoder()
        frames: List[Frame] = decoder.feed(data)
        while decoder.pending:
            frames += decoder.give_up()
        valid = [len(frame.raw) for frame in frames if frame.message is not None]
        invalid = sum(len(frame.raw) for frame in frames if frame.cause not in ('', UNKNOWN))
        if len(valid) >= _FRAMES and sum(valid) > max(invalid, most):
            name, most = each.board.name, sum(valid)
    return name


def _answer(url: str, candidate: Candidate) -> bytes:
    """The bytes with which a board answers its question; b'': it does not."""
    decoder = candidate.decoder()
    data = b''

    def received(more: bytes) -> bool:
        nonlocal data
        data += more
        return any(frame.message is not None for frame in decoder.feed(more))

    port = Port(url, candidate.baud)
    try:
        port.open()
        for _ in range(_QUESTIONS):
            try:
                port.write(candidate.board.question)
            except PortBusy:
                pass
            if _read(port, _ANSWER, received):
                return data
    finally:
        port.close()
    return b''


def _read(port: Port, seconds: float, received: Callable[[bytes], bool]) -> bool:
    """Read until `received` returns true, and return whether it did within `seconds`."""
    deadline = time.monotonic() + seconds
    while True:
        left = deadline - time.monotonic()
        if left <= 0:
            return False
        data = port.read(left)
        if data and received(data):
            return True
