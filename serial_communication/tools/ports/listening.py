"""Listens to a port and finds out which board is on it."""
import re
import time
from functools import partial
from typing import Any, Callable, Iterable, List, NamedTuple, Optional, Tuple

from ...framing.stream import UNKNOWN, Frame
from ...transport.port import Port, PortBusy, PortError
from ..wire.lines import Settings

USUAL = (9600, 57600, 38400, 19200, 230400, 460800, 921600, 500000, 250000, 1000000)    # baud
_STARTUP = 2.0    # s more for a silent port: opening it may have reset its board
_OTHER = 0.7      # s that is enough to recognise a board at another rate, at most
_ANSWER = 0.3     # s for an answer
_QUESTIONS = 3    # times that a question is asked
_FRAMES = 3       # the fewest valid frames by which a board is recognised


class Received(NamedTuple):
    """What was received on a port."""

    board: str = ''                # '': none is recognised
    baud: Optional[int] = None     # at which its frames are valid
    data: bytes = b''
    trouble: str = ''              # why the port cannot be listened to


def listen(url: str, boards: List[Settings], seconds: float, ask: bool) -> Received:
    """What is received on a port. Nothing is written, but for questions to a silent one.

    Args:
        boards: that may be there, with the rates at which a bridge would open the port.
        seconds: to listen, at each of these rates; at others less.
        ask: whether boards that send only when they are asked are asked.
    """
    rates = list(dict.fromkeys(each.baud for each in boards))
    try:
        first = b''
        for baud in dict.fromkeys([*rates, *(each.board.baud for each in boards), *USUAL]):
            data, name = _receive(url, baud, seconds if baud in rates else min(seconds, _OTHER),
                                  partial(recognised, boards), _STARTUP * (baud == rates[0]))
            if name:
                return Received(name, baud, data)
            first = first or data
            if not first and baud == rates[-1]:
                break     # silent at every rate that a bridge would use
        for each in boards if ask and not first else ():
            for _ in range(_QUESTIONS if each.board.question else 0):
                data, answer = _receive(url, each.baud, _ANSWER, partial(_answers, each),
                                        question=each.board.question)
                if answer:
                    return Received(each.board.name, each.baud, data)
        return Received(data=first)
    except (PortError, PortBusy) as error:
        return Received(trouble=re.sub('; (waiting|`rosrun).*', '', str(error)))


def _receive(url: str, baud: int, seconds: float, find: Callable[[bytes], Any],
             more: float = 0.0, question: bytes = b'') -> Tuple[bytes, Any]:
    """The bytes received at one rate until `find` finds something in them, and that. The `question`
    is sent first. It takes so many seconds, and `more` while nothing is received."""
    port, data, look_at = Port(url, baud), b'', 1
    try:
        port.open()
        if question:
            port.write(question)
        began = time.monotonic()
        while True:
            left = began + seconds + (0.0 if data else more) - time.monotonic()
            if left <= 0:
                return data, find(data)
            data += port.read(left)
            if len(data) >= look_at:      # seldom, or it would take too long
                look_at, found = 2 * len(data), find(data)
                if found:
                    return data, found
    finally:
        port.close()


def _frames(board: Settings, data: bytes) -> List[Frame]:
    decoder = board.decoder()
    frames = decoder.feed(data)
    while decoder.pending:
        frames += decoder.give_up()
    return frames


def _answers(board: Settings, data: bytes) -> bool:
    return any(frame.message is not None for frame in _frames(board, data))


def recognised(boards: Iterable[Settings], data: bytes) -> str:
    """The name of the board whose frames these bytes are, or ''.

    Bytes of another board, of another baud rate or of noise are sometimes a valid frame by chance,
    above all without a checksum. So it needs several valid ones that have most of the bytes.
    """
    name, most = '', 0
    for each in boards:
        frames = _frames(each, data)
        valid = [len(frame.raw) for frame in frames if frame.message is not None]
        invalid = sum(len(frame.raw) for frame in frames if frame.cause not in ('', UNKNOWN))
        if len(valid) >= _FRAMES and sum(valid) > max(invalid, most):
            name, most = each.board.name, sum(valid)
    return name
