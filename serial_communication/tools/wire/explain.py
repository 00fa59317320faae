r"""Explains bytes of a serial line, field by field: the meaning of each, and what is wrong with it.

Bytes may be written A5 02 55, a50255, 0xA5,0x02, \xa5\x02, b'\xa5\x02', or in brackets [165, 2],
as rostopic echo prints them; as arguments or on standard input.

  wire explain bus A5 02 55 20 00 64 B6
  wire explain mcu 020c109c2f003a0000000dfff3009803
  rostopic echo -n 1 /serial_msg/frame | wire explain arduino -

The bytes show, for each frame, whether the computer or the board sent it. There may be several
frames, with noise between them. An incomplete frame is explained as far as it goes. Status 0: all
frames are valid; 1: not all are; 2: wrong arguments, or not hex.
"""
import argparse
import ast
import re
import sys
from typing import Any, Iterator, List, NamedTuple, Optional, Tuple

from ...framing.layout import words
from ...framing.stream import FRAMING, Frame
from . import lines
from .fields import NOT_KNOWN, Explainer, Part
from .lines import Settings

SUMMARY = 'explain bytes, field by field, and what is wrong with them'

_MOST_BYTES = 8         # of a field on one line; a longer field continues on the next


class NotHex(lines.UsageError):
    """The text is not hex."""


class Explained(NamedTuple):
    """A frame or a stretch of noise, with its parts."""

    sent: bool
    frame: Frame
    parts: List[Part]

    @property
    def trouble(self) -> str:
        """What is wrong with it, in one line; '' if it is valid."""
        if self.frame.cause == FRAMING and any(part.missing for part in self.parts):
            return 'incomplete'
        return self.frame.trouble or '; '.join(part.error for part in self.parts if part.error)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire explain`."""
    lines.add_options(parser)
    parser.add_argument('hex', metavar='HEX', nargs='*', help='the bytes; - for standard input')


def run(options: argparse.Namespace) -> int:
    """Explain the bytes and return the exit status."""
    line = lines.settings(options)
    text = ' '.join(options.hex) if options.hex and options.hex != ['-'] else sys.stdin.read()
    found = explain(parse(text), line)
    print('\n\n'.join(map(render, found)) or 'only empty packets')
    return 1 if any(each.trouble for each in found) else 0


def parse(text: str) -> bytes:
    """Return the bytes of a text in any of the forms above; NotHex if it has none."""
    text = re.sub(r'\s*---$', '', text.strip())
    try:
        if re.match(r'b["\']|\[\d+\s*(,|\]$)', text):
            data = bytes(ast.literal_eval(text))
        else:
            tokens = re.split(r'[\s,;:|\'"\[\](){}]+|(?=\\x)', text)
            digits = [re.sub(r'^(0x|\\x|\$)', '', token, flags=re.I) for token in tokens]
            data = b''.join(bytes.fromhex('0' * (len(each) == 1) + each) for each in digits)
    except (ValueError, SyntaxError):
        raise NotHex(f'{text[:40]!r} is not hex: see --help') from None
    if not data:
        raise NotHex('there are no bytes')
    return data


def explain(data: bytes, line: Settings, sent: Optional[bool] = None) -> List[Explained]:
    """Return every frame and every stretch of noise in `data`, in order.

    Args:
        sent: whether `data` was sent to the board; None: decided for each frame.
    """
    explainers = {sender: Explainer(line, sender)
                  for sender in ((False, True) if sent is None else (sent,))}
    found: List[Explained] = []
    request: Any = None
    for sender, frame in _frames(data, explainers):
        # A reply is explained with the request before it, which defines the reply's DATE.
        found.append(Explained(sender, frame, explainers[sender].parts(frame.raw, request)))
        request = frame.message if sender else None
    return found


def _frames(data: bytes, explainers: Any) -> Iterator[Tuple[bool, Frame]]:
    """The frames and noise in `data`, each with its sender.

    Valid frames of either end are found first, since `data` may hold both directions. The bytes
    between them are of whichever direction is more plausible.
    """
    valid = [(len(data) - frame.behind - len(frame.raw), sender, frame)
             for sender, explainer in explainers.items()
             for frame in explainer.decode(data) if not frame.cause]
    end = 0
    for start, sender, frame in sorted(valid, key=lambda each: (each[0], -len(each[2].raw))):
        if start >= end:
            yield from _gap(data[end:start], explainers)
            yield sender, frame
            end = start + len(frame.raw)
    yield from _gap(data[end:], explainers)


def _gap(data: bytes, explainers: Any) -> List[Tuple[bool, Frame]]:
    """What bytes are that hold no valid frame."""
    def doubts(found: List[Tuple[bool, Frame]]) -> int:
        parts = [part for sender, frame in found for part in explainers[sender].parts(frame.raw)]
        return sum(bool(part.error or part.meaning == NOT_KNOWN) for part in parts)

    return min(([(sender, frame) for frame in explainer.decode(data)]
                for sender, explainer in explainers.items()), key=doubts)


def render(each: Explained) -> str:
    """Return a frame as text: a line for the whole, and lines for each part."""
    raw = each.frame.raw
    text = [f'from the {"computer" if each.sent else "board"}, {len(raw)} bytes: '
            f'{each.trouble or each.frame.text}']
    is_encoded = any(part.data != raw[part.start:part.end] for part in each.parts)
    if is_encoded:
        text.append(f'  {"on the wire":25}decoded')
    for part in each.parts:
        wire, data = raw[part.start:part.end], part.data
        value = '' if part.value is None else words(part.value, part.unit)
        if part.value != part.raw:
            value += f' (sent as {words(part.raw, "")})'
        meaning = f'{part.name:18}' + '  '.join(filter(None, (value, part.meaning, part.error)))
        for at in range(0, max(len(wire), len(data), 1), _MOST_BYTES):
            columns = f'  {wire[at:at + _MOST_BYTES].hex(" "):25}'
            if is_encoded:
                columns += f'{data[at:at + _MOST_BYTES].hex(" "):25}'
            text.append((columns + meaning * (not at)).rstrip())
    return '\n'.join(text)
