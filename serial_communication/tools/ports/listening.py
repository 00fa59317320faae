"""Listens to a port and finds out which board is on it."""
import re
import time
from typing import Any, Callable, Iterable, List, Mapping, NamedTuple, Optional

from ...boards.description import Description
from ...framing.stream import UNKNOWN, Decoder
from ...transport.port import Port, PortBusy, PortError

USUAL = (9600, 57600, 38400, 19200, 230400, 460800, 921600, 500000, 250000, 1000000)    # baud
_STARTUP = 2.0    # s more for a silent port: opening it may have reset its board
_OTHER = 0.7      # s that is enough to recognise a board at another rate, at most
_ANSWER = 0.3     # s for an answer
_QUESTIONS = 3    # times that a question is asked
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
    data: bytes = b''              # at the first rate
    trouble: str = ''              # why the port cannot be listened to

    @property
    def kind(self) -> str:
        """'frames', 'noise' or 'nothing'."""
        return 'frames' if self.board else 'noise' if self.data else 'nothing'


def listen(url: str, candidates: List[Candidate], seconds: float, ask: bool) -> Received:
    """What is received on a port. Nothing is written, but for questions to a silent one.

    Args:
        candidates: the boards to recognise.
        seconds: to listen, at each rate that a bridge would use.
        ask: whether boards that send only when they are asked are asked.
    """
    try:
        rates = list(dict.fromkeys(each.baud for each in candidates))
        first = Received()
        for baud in dict.fromkeys([*rates, *(each.board.baud for each in candidates), *USUAL]):
            is_first = baud == rates[0]
            heard = _listen_at(url, baud, candidates, seconds if baud in rates else
                               min(seconds, _OTHER), _STARTUP if is_first else 0.0)
            first = heard if is_first else first
            if heard.board:
                return heard
            if not first.data and baud == rates[-1]:
                break     # silent at every rate that a bridge would use
        if first.data or not ask:
            return first
        answers = (_answer(url, each) for each in candidates if each.board.question)
        return next(filter(None, answers), first)
    except PortError as error:
        return Received(trouble=re.sub('; (waiting|`rosrun).*', '', str(error)))


def _listen_at(url: str, baud: int, candidates: List[Candidate], seconds: float,
               more: float) -> Received:
    """Listen at one rate, until a board is recognised; `more` seconds if nothing is received."""
    heard, name, look_at = b'', '', 0

    def received(data: bytes) -> bool:
        nonlocal heard, name, look_at
        heard += data
        if len(heard) >= look_at:
            name, look_at = recognised(candidates, heard), 2 * len(heard)
        return bool(name)

    port = Port(url, baud)
    try:
        port.open()
        _read(port, seconds, received)
        if not heard:
            _read(port, more, received)
    finally:
        port.close()
    name = name or recognised(candidates, heard)
    return Received(name, baud if name else None, heard)


def recognised(candidates: Iterable[Candidate], data: bytes) -> str:
    """The name of the board whose frames these bytes are, or ''.

    Bytes of another board, of another baud rate or of noise are sometimes a valid frame by chance,
    above all without a checksum. So it needs several valid ones that have most of the bytes.
    """
    name, most = '', 0
    for each in candidates:
        decoder = each.decoder()
        frames = decoder.feed(data)
        while decoder.pending:
            frames += decoder.give_up()
        valid = [len(frame.raw) for frame in frames if frame.message is not None]
        invalid = sum(len(frame.raw) for frame in frames if frame.cause not in ('', UNKNOWN))
        if len(valid) >= _FRAMES and sum(valid) > max(invalid, most):
            name, most = each.board.name, sum(valid)
    return name


def _answer(url: str, candidate: Candidate) -> Optional[Received]:
    """What a board answers to its question; None: nothing valid."""
    decoder, data = candidate.decoder(), b''

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
                return Received(candidate.board.name, candidate.baud, data)
    finally:
        port.close()
    return None


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
