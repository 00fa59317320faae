"""A frame of serial_msg as the page shows it."""
from typing import Any, List

_MOST_BYTES = 300       # of a frame that are shown; the longest good one of a board is shorter


def describe(message: Any, at: float) -> List[Any]:
    """[time, link, sent, type, words, error, bytes in hex, fields] of one SerialMsg.

    A field is [name, first byte, byte after its last, words].
    """
    raw = bytes(message.frame[:_MOST_BYTES])
    return [round(at, 4), message.link, message.direction, message.type, message.text,
            message.error, raw.hex(), []]
