"""What a simulated board announces: see `framing.announcement`."""
from typing import Any, Dict, List

from ..framing.announcement import LONGEST, MOST_ROWS, Chunk, crc_of


def chunks_of(text: bytes, size: int) -> List[Chunk]:
    """The chunks of a text, with at most `size` bytes of it each; at most 255 of them."""
    pieces = [text[at:at + size] for at in range(0, len(text), size)] or [b'']
    crc = crc_of(text)
    return [Chunk(index, len(pieces), crc, piece) for index, piece in enumerate(pieces)]


def write_announcement(rows: Dict[str, Any], firmware: str = '') -> bytes:
    """The text that announces these rows; ValueError if it is too long, or there are too many."""
    import yaml
    # Writes out what two keys share, since an announcement may have no references.
    dumper = type('Dumper', (yaml.SafeDumper,), {'ignore_aliases': lambda self, data: True})
    lines = [f'firmware: {firmware}'] if firmware else []
    for name, row in rows.items():
        flow = yaml.dump({name: row}, Dumper=dumper, default_flow_style=True,
                         sort_keys=False, width=float('inf'), allow_unicode=True)
        lines.append(flow.strip()[1:-1])       # without the braces of the group
    text = ''.join(line + '\n' for line in lines).encode()
    if len(rows) > MOST_ROWS or len(text) > LONGEST:
        raise ValueError(f'{len(rows)} rows in {len(text)} bytes cannot be announced; there may be '
                         f'{MOST_ROWS} in {LONGEST} bytes')
    return text
