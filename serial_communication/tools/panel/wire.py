"""Frames of serial_msg as the page shows them: text, bytes, and the field of each byte."""
from typing import Any, Dict, Iterable, List, Tuple

from ...simulation.arguments import board_parameters
from ...boards.description import Description
from ...framing.layout import words
from ..wire.fields import Explainer, Part
from ..wire.lines import Settings

_MAX_BYTES = 300       # of a frame that are shown; valid frames of the built-in boards are shorter


class FrameExplainer:
    """Explains frames as a bridge with these parameters decodes them.

    Args:
        boards: of the bridge.
        parameters: the bridge's private parameters, nested; a missing one has its default.
    """

    def __init__(self, boards: Iterable[Description], parameters: Any) -> None:
        self._explainers: Dict[Tuple[str, bool], Explainer] = {}
        for board in boards:
            for sent in (False, True):
                own = board_parameters(parameters, board.name)
                try:
                    explainer = Explainer(Settings(board, 0, own), sent)
                except ValueError:      # a bridge with such parameters does not start
                    explainer = Explainer(Settings(board, 0), sent)
                self._explainers[board.name, sent] = explainer

    def explain(self, message: Any, at: float) -> List[Any]:
        """[time, link, sent, type, text, error, bytes in hex, parts] of one SerialMsg.

        A part is [name, index of its first byte, index after its last, value as text, error].
        """
        raw = bytes(message.frame[:_MAX_BYTES])
        explainer = self._explainers.get((message.link, bool(message.direction)))
        parts = explainer.parts(raw) if explainer else []
        return [round(at, 4), message.link, message.direction, message.type, message.text,
                message.error, raw.hex(), [[part.name, part.start, part.end, _value_text(part),
                                            part.error] for part in parts]]


def _value_text(part: Part) -> str:
    """The part's value with its unit and its meaning."""
    text = part.data.hex(' ') if part.value is None else words(part.value, part.unit)
    return f'{text} ({part.meaning})' if part.meaning else text
