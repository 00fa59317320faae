"""What the tests of decoders share: the byte-exact examples of the protocols, counts of errors."""
import json
from collections import Counter
from pathlib import Path
from typing import Dict, Iterable, List

from serial_communication.framing.stream import Frame


def vectors(protocol: str) -> Dict[str, List[dict]]:
    """The byte-exact examples of one protocol."""
    path = Path(__file__).parents[1] / 'unit' / 'boards' / 'vectors' / f'{protocol}.json'
    return json.loads(path.read_text(encoding='utf-8'))


def hexed(text: str) -> bytes:
    """Bytes from the vectors' notation."""
    return bytes.fromhex(text)


def errors_of(frames: Iterable[Frame]) -> Dict[str, int]:
    """How many errors of each cause there are."""
    return Counter(frame.cause for frame in frames if frame.cause)
