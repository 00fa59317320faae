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
from typing import Any, Iterable, List, NamedTuple, Optional, Sequence, Tuple

from ...framing.layout import words
from ...framing.stream import FRAMING, Frame
from . import lines
from .announced import with_announced
from .fields import NOT_KNOWN, Explainer, Part
from .lines import Settings
from .show import Paint, hexed

SUMMARY = 'explain bytes, field by field, and what is wrong with them'

_FORMS = r"bytes are written A5 02 55, a50255, 0xA5,0x02, \xa5\x02, b'\xa5\x02' or [165, 2]"
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
    one = parser.add_mutually_exclusive_group()
    one.add_argument('--sent', action='store_const', const=True, dest='sent',
                     help='the computer sent the bytes (bus: a request)')
    one.add_argument('--received', action='store_const', const=False, dest='sent',
                     help='the board sent the bytes (bus: a reply)')


def run(options: argparse.Namespace) -> int:
    """Explain the bytes and return the exit status."""
    words = options.hex
    text = ' '.join(words) if words and words != ['-'] else sys.stdin.read()
    found = explain(parse(text), lines.settings(options), options.sent)
    print('\n\n'.join(render(each, Paint()) for each in found) or 'only empty packets')
    return 1 if any(each.trouble for each in found) else 0


# -- text to bytes --------------------------------------------------------------------------


def parse(text: str) -> bytes:
    """Return the bytes of a text in any of the forms above.

    Raises:
        NotHex: the text has none of these forms, or no bytes.
    """
    text = text.strip()
    if text.startswith(("b'", 'b"')) or re.fullmatch(r'\[[\d,\s]*\](\s*---)?', text):
        data = _literal(re.sub(r'\s*---$', '', text))
    else:
        data = b''.join(map(_token, re.split(r'[\s,;:|\'"\[\](){}]+|(?=\\x)', text)))
    if not data:
        raise NotHex(f'there are no bytes; {_FORMS}')
    return data


def _literal(text: str) -> bytes:
    try:
        return bytes(ast.literal_eval(text))
    except (ValueError, SyntaxError):
        raise NotHex(f'{text[:40]!r} is not a valid bytes literal; {_FORMS}') from None


def _token(text: str) -> bytes:
    digits = re.sub(r'^(0x|\\x|\$)', '', text, flags=re.IGNORECASE)
    if len(digits) == 1:
        digits = '0' + digits
    if not re.fullmatch('([0-9a-fA-F]{2})*', digits) or (text and not digits):
        odd = ' (an odd number of digits)' if re.fullmatch('[0-9a-fA-F]+', digits) else ''
        raise NotHex(f'{text[:40]!r} is not hex{odd}; {_FORMS}')
    return bytes.fromhex(digits)


# -- bytes to parts -------------------------------------------------------------------------


def explain(data: bytes, line: Settings, sent: Optional[bool] = None) -> List[Explained]:
    """Return every frame and every stretch of noise in `data`, in order.

    Args:
        sent: whether `data` was sent to the board; None: decided for each frame.

    Valid frames of either end are found first, since `data` may hold both directions. The bytes
    between them are explained as whichever direction is more plausible. What the board announces in
    `data` is known everywhere in it.
    """
    found = _explain(data, line, sent)
    learned = with_announced(line, [(each.sent, each.frame) for each in found])
    return found if learned is line else _explain(data, learned, sent)


def _explain(data: bytes, line: Settings, sent: Optional[bool]) -> List[Explained]:
    senders = (False, True) if sent is None else (sent,)
    found: List[Explained] = []
    end = 0
    valid = [(start, each) for sender in senders for start, each in _split(data, line, sender)
             if not each.frame.cause]
    for start, each in sorted(valid, key=lambda placed: (placed[0], -len(placed[1].frame.raw))):
        if start >= end:
            found += _explain_gap(data[end:start], line, senders) + [each]
            end = start + len(each.frame.raw)
    return _match_replies(found + _explain_gap(data[end:], line, senders), line)


def _explain_gap(data: bytes, line: Settings, senders: Iterable[bool]) -> List[Explained]:
    """Explain bytes that hold no valid frame."""
    return max(([each for _, each in _split(data, line, sender)] for sender in senders),
               key=_plausibility)


def _split(data: bytes, line: Settings, sent: bool) -> List[Tuple[int, Explained]]:
    """The frames and noise that the decoder of one direction finds, each with its start.

    Together they have all bytes of `data`.
    """
    explainer = Explainer(line, sent)
    decoder = explainer.decoder
    frames = decoder.feed(data, 0.0)
    while decoder.pending:
        frames += decoder.give_up()
    found: List[Tuple[int, Explained]] = []
    nothing = line.board.between
    end = at = 0

    def add(start: int, frame: Frame) -> None:
        found.append((start, Explained(sent, frame, explainer.parts(frame.raw))))

    def noise(start: int, behind: int) -> None:
        rest = data[start:behind].lstrip(nothing)
        if rest:
            add(behind - len(rest), Frame(
                rest, 0, 0, b'', None, None, FRAMING,
                f'{len(rest)} bytes outside frames' if len(rest) > 1 else '1 byte outside frames'))

    for frame in frames:
        start = data.find(frame.raw, at)
        if nothing and start >= 0:      # the next frame begins behind the end of this one
            at = data.find(nothing, start + len(frame.raw) - 1) + 1 or len(data)
        if frame.cause == FRAMING or start < 0:
            continue     # a noise frame may quote only a part; noise is what no other frame has
        noise(end, start)
        add(start, frame)
        end = max(end, start + len(frame.raw))
        if not nothing:     # the next frame may begin inside an invalid one
            at = start + 1 if frame.cause else end
    noise(end, len(data))
    return found


def _plausibility(found: Sequence[Explained]) -> Tuple[int, int, int]:
    """The sort key of a guess at the sender: more valid bytes, then fewer wrong fields."""
    parts = [part for each in found for part in each.parts]
    return (sum(len(each.frame.raw) for each in found if not each.trouble),
            -sum(bool(part.error or part.meaning == NOT_KNOWN) for part in parts),
            -sum(part.missing > 0 for part in parts))


def _match_replies(found: Sequence[Explained], line: Settings) -> List[Explained]:
    """Explain each reply again with the request before it, which defines the reply's DATE."""
    replies = Explainer(line, False)
    matched: List[Explained] = []
    request: Any = None
    for each in found:
        if each.sent:
            request = each.frame.message
        elif request:
            each = each._replace(parts=replies.parts(each.frame.raw, request))
            request = None
        matched.append(each)
    return matched


# -- parts to text --------------------------------------------------------------------------


def render(each: Explained, paint: Paint) -> str:
    """Return a frame as text: a line for the whole, and lines for each part."""
    sender = 'computer' if each.sent else 'board'
    raw = each.frame.raw
    text = paint(each.trouble, 'bad') if each.trouble else each.frame.text
    lined = [f'{paint("from the " + sender, sender)}, {len(raw)} bytes: {text}']
    is_encoded = any(part.data != raw[part.start:part.end] for part in each.parts)
    if is_encoded:
        lined.append(paint(f'  {"on the wire":25}{"decoded":25}', 'dim'))
    for part in each.parts:
        lined += _render_part(part, raw, is_encoded, paint)
    return '\n'.join(lined)


def _render_part(part: Part, raw: bytes, is_encoded: bool, paint: Paint) -> List[str]:
    wire, data = raw[part.start:part.end], part.data
    value = '' if part.value is None else words(part.value, part.unit)
    if part.value != part.raw:
        value += f' (sent as {words(part.raw, "")})'
    notes = [value, part.meaning, paint(part.error, 'bad')]
    text = []
    for at in range(0, max(len(wire), len(data), 1), _MOST_BYTES):
        columns = f'  {hexed(wire[at:at + _MOST_BYTES]):25}'
        if is_encoded:
            columns += f'{hexed(data[at:at + _MOST_BYTES]):25}'
        if not at:
            columns += f'{part.name:18}' + '  '.join(note for note in notes if note)
        text.append(columns.rstrip())
    return text
