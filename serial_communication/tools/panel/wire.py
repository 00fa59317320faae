"""Frames of serial_msg as the page shows them: text, bytes, and the field of each byte."""
from typing import Any, Dict, Iterable, List, Tuple

from ...boards.config_file import board_parameters
from ...boards.description import Description
from ...framing.parts import Part
from ...framing.stream import Decoder

_MAX_BYTES = 300       # of a frame that are shown; valid frames of the built-in boards are shorter


class FrameExplainer:
    """Explains frames as a bridge with these parameters decodes them.

    Args:
        boards: of the bridge.
        parameters: the bridge's private parameters, nested; a missing one has its default.
    """

    def __init__(self, boards: Iterable[Description], parameters: Any) -> None:
        self._decoders: Dict[Tuple[str, bool], Decoder] = {}
        for board in boards:
            for sent in (False, True):
                try:
                    decoder = board.decoder(sent, board_parameters(parameters, board.name))
                except ValueError:      # a bridge with such parameters does not start
                    decoder = board.decoder(sent, {})
                self._decoders[board.name, sent] = decoder

    def explain(self, message: Any, at: float) -> List[Any]:
        """[time, link, sent, type, text, error, bytes in hex, parts] of one SerialMsg.

        A part is [name, index of its first byte, index after its last, value as text, error].
        """
        raw = bytes(message.frame[:_MAX_BYTES])
        decoder = self._decoders.get((message.link, bool(message.direction)))
        parts = decoder.explain(raw) if decoder else []
        return [round(at, 4), message.link, message.direction, message.type, message.text,
                message.error, raw.hex(), [[part.name, part.start, part.end, _value_text(part),
                                            part.error] for part in parts]]


def _value_text(part: Part) -> str:
    """The part's value with its unit and its meaning."""
    value = part.raw if part.value is None else part.value
    text = part.data.hex(' ') if value is None else \
        f'{value:.6g}' if isinstance(value, float) else str(value)
    if part.meaning:
        return f'{text} {part.unit} ({part.meaning})' if part.unit else f'{text} ({part.meaning})'
    return f'{text} {part.unit}' if part.unit else text
