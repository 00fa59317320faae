"""Frames of serial_msg as the page shows them: words, bytes, and which byte is what."""
from typing import Any, Dict, List, Tuple

from ...protocols import arduino, mcu
from ...protocols import robot_ctrl_bus as bus
from ...protocols.own_messages import RowError, arduino_messages, mcu_messages
from ...protocols.parts import Part

_MOST_BYTES = 300       # of a frame that are shown; the longest good one of a board is shorter


def _given(parameters: Any, link: str, key: str) -> Any:
    group = parameters.get(link) if isinstance(parameters, dict) else None
    return group.get(key) if isinstance(group, dict) else None


class Wire:
    """Explains frames as a bridge with these parameters decodes them.

    Args:
        parameters: the node's private ones, nested; what is not known there counts as left out.
    """

    def __init__(self, parameters: Any) -> None:
        own: List[Any] = []
        for read, link in ((arduino_messages, 'arduino'), (mcu_messages, 'mcu')):
            try:
                own.append(read(_given(parameters, link, 'messages') or {}))
            except RowError:
                own.append([])      # such a bridge does not start
        cars, sensors = own
        self._decoders: Dict[Tuple[str, bool], Any] = {
            ('bus', False): bus.ReplyDecoder(bool(_given(parameters, 'bus', 'reply_has_cmd2'))),
            ('bus', True): bus.RequestDecoder(),
            ('arduino', False): arduino.Decoder(
                messages=[each.kind for each in cars if not each.is_command]),
            ('arduino', True): arduino.BoardDecoder(
                messages=[each.kind for each in cars if each.is_command]),
            ('mcu', False): mcu.Decoder([each.kind for each in sensors])}

    def describe(self, message: Any, at: float) -> List[Any]:
        """[time, link, sent, type, words, error, bytes in hex, parts] of one SerialMsg.

        A part is [name, first byte, byte after its last, words, what is wrong with it].
        """
        raw = bytes(message.frame[:_MOST_BYTES])
        decoder = self._decoders.get((message.link, bool(message.direction)))
        parts = decoder.explain(raw) if decoder else []
        return [round(at, 4), message.link, message.direction, message.type, message.text,
                message.error, raw.hex(), [[part.name, part.start, part.end, _words(part),
                                            part.error] for part in parts]]


def _words(part: Part) -> str:
    """The part's value, and what it means."""
    value = part.raw if part.value is None else part.value
    text = part.data.hex(' ') if value is None else \
        f'{value:.6g}' if isinstance(value, float) else str(value)
    if part.meaning:
        return f'{text} {part.unit} ({part.meaning})' if part.unit else f'{text} ({part.meaning})'
    return f'{text} {part.unit}' if part.unit else text
