"""The byte-exact examples of the protocols."""
import json
from pathlib import Path
from typing import Dict, List


def vectors(protocol: str) -> Dict[str, List[dict]]:
    """The byte-exact examples of one protocol."""
    path = Path(__file__).parents[1] / 'boards' / 'vectors' / f'{protocol}.json'
    return json.loads(path.read_text(encoding='utf-8'))


def hexed(text: str) -> bytes:
    """Bytes from the vectors' notation."""
    return bytes.fromhex(text)
