r"""Bytes of a serial line, field by field: what each is, what it means, what is wrong with it.

Bytes are taken as people have them: A5 02 55, a50255, 0xA5,0x02, \xa5\x02, b'\xa5\x02', or in
brackets [165, 2], as rostopic echo prints them; as arguments, or on standard input.

  wire explain bus A5 02 55 20 00 64 B6
  wire explain mcu 020c109c2f003a0000000dfff3009803
  rostopic echo -n 1 /serial_msg/frame | wire explain arduino -

Whether the computer or the board said it is found out from the bytes, for each frame on its own.
Several frames may stand together, with noise between them; a frame that is cut short is explained
as far as it goes. Status 0: all of it was sound; 1: not all; 2: this is no hex.
"""
import argparse
import ast
import json
import math
import re
import sys
from typing import Any, Iterable, List, NamedTuple, Optional, Sequence, Tuple

from ...boards.description import Command
from ...framing.parts import Part
from ...framing.stream import FRAMING, Frame
from . import lines
from .lines import Settings
from .show import Paint, hexed

SUMMARY = 'bytes, field by field: what each means, and what is wrong'

_FORMS = r"bytes are written A5 02 55, a50255, 0xA5,0x02, \xa5\x02, b'\xa5\x02' or [165, 2]"
_MOST_BYTES = 8         # of a field on a line; a longer one goes on on the next


class NoHex(lines.Unusable):
    """The text says what is no hex."""


class Explained(NamedTuple):
    """A frame, or a stretch of bytes that is none, in its parts."""

    sent: bool
    frame: Frame
    parts: List[Part]

    @property
    def missing(self) -> int:
        """Fields of which bytes are missing."""
        return sum(bool(part.missing) for part in self.parts)

    @property
    def trouble(self) -> str:
        """What is wrong with it, in a line; '' where nothing is."""
        if self.frame.cause == FRAMING and self.missing:
            return 'incomplete'
        return self.frame.trouble or '; '.join(part.error for part in self.parts if part.error)


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the command line may say."""
    lines.add_link_options(parser)
    parser.add_argument('hex', metavar='HEX', nargs='*', help='the bytes; - for standard input')
    one = parser.add_mutually_exclusive_group()
    one.add_argument('--sent', action='store_const', const=True, dest='sent',
                     help='the computer said it (bus: a request)')
    one.add_argument('--received', action='store_const', const=False, dest='sent',
                     help='the board said it (bus: a reply)')
    parser.add_argument('--json', action='store_true', help='the same for a program')


def run(options: argparse.Namespace) -> int:
    """Explain; the exit status."""
    words = options.hex
    text = ' '.join(words) if words and words != ['-'] else sys.stdin.read()
    found = explain(parse(text), lines.settings(options), options.sent)
    if options.json:
        print(json.dumps({'sound': not any(each.trouble for each in found),
                          'frames': [as_dict(each) for each in found]}, indent=1))
    else:
        print('\n\n'.join(render(each, Paint()) for each in found)
              or 'empty packets, which say nothing')
    return 1 if any(each.trouble for each in found) else 0


# -- text to bytes --------------------------------------------------------------------------


def parse(text: str) -> bytes:
    """The bytes in any of the forms above.

    Raises:
        NoHex: it is none of them, or empty.
    """
    text = text.strip()
    if text.startswith(("b'", 'b"')) or re.fullmatch(r'\[[\d,\s]*\](\s*---)?', text):
        data = _literal(re.sub(r'\s*---$', '', text))
    else:
        data = b''.join(map(_token, re.split(r'[\s,;:|\'"\[\](){}]+|(?=\\x)', text)))
    if not data:
        raise NoHex(f'there are no bytes; {_FORMS}')
    return data


def _literal(text: str) -> bytes:
    try:
        return bytes(ast.literal_eval(text))
    except (ValueError, SyntaxError):
        raise NoHex(f'{text[:40]!r} is not how Python writes bytes; {_FORMS}') from None


def _token(text: str) -> bytes:
    digits = re.sub(r'^(0x|\\x|\$)', '', text, flags=re.IGNORECASE)
    if len(digits) == 1:
        digits = '0' + digits
    if not re.fullmatch('([0-9a-fA-F]{2})*', digits) or (text and not digits):
        odd = ' (an odd number of digits)' if re.fullmatch('[0-9a-fA-F]+', digits) else ''
        raise NoHex(f'{text[:40]!r} is no hex{odd}; {_FORMS}')
    return bytes.fromhex(digits)


# -- bytes to parts -------------------------------------------------------------------------


def explain(data: bytes, line: Settings, sent: Optional[bool] = None) -> List[Explained]:
    """Every frame and every stretch of noise in `data`; who said it is found out where None.

    Sound frames come first: what one end cannot have said, the other may have, and both may
    stand in one text. What lies between them is told as what it is likeliest to be.
    """
    speakers = (False, True) if sent is None else (sent,)
    found: List[Explained] = []
    end = 0
    sound = [(start, each) for speaker in speakers for start, each in _split(data, line, speaker)
             if not each.frame.cause]
    for start, each in sorted(sound, key=lambda placed: (placed[0], -len(placed[1].frame.raw))):
        if start >= end:
            found += _between(data[end:start], line, speakers) + [each]
            end = start + len(each.frame.raw)
    return _in_turn(found + _between(data[end:], line, speakers), line)


def _between(data: bytes, line: Settings, speakers: Iterable[bool]) -> List[Explained]:
    """What holds no sound frame."""
    return max(([each for _, each in _split(data, line, speaker)] for speaker in speakers),
               key=_soundness)


def _split(data: bytes, line: Settings, sent: bool) -> List[Tuple[int, Explained]]:
    """As the decoder of one end cuts them, with where each begins; all bytes are in one."""
    decoder = lines.decoder(line, sent)
    frames = decoder.feed(data, 0.0)
    while decoder.pending:
        frames += decoder.give_up()
    found: List[Tuple[int, Explained]] = []
    nothing = line.board.between
    end = at = 0

    def add(start: int, frame: Frame) -> None:
        found.append((start, Explained(sent, frame, decoder.explain(frame.raw))))

    for frame in frames:
        start = data.find(frame.raw, at)
        if frame.cause == FRAMING or start < 0:
            continue     # noise is quoted in part only: it is all that no other frame has
        if data[end:start].strip(nothing):
            add(end, _noise(data[end:start]))
        add(start, frame)
        end = max(end, start + len(frame.raw))
        # Inside a frame whose checksum is wrong, the next may begin.
        at = start + 1 if frame.cause else end
    if data[end:].strip(nothing):
        add(end, _noise(data[end:]))
    return found


def _noise(data: bytes) -> Frame:
    return Frame(data, 0, 0, b'', None, None, FRAMING,
                 f'{len(data)} bytes that are no frame' if len(data) > 1 else
                 '1 byte that is no frame')


def _soundness(found: Sequence[Explained]) -> Any:
    """The more of it is sound, and the fewer fields are wrong, the likelier is the speaker."""
    parts = [part for each in found for part in each.parts]
    return (sum(len(each.frame.raw) for each in found if not each.trouble),
            -sum(bool(part.error or part.kind == '') for part in parts),
            -sum(each.missing for each in found))


def _in_turn(found: Sequence[Explained], line: Settings) -> List[Explained]:
    """A reply behind its request: then it is known what its DATE is."""
    if line.board.command is not Command.FUNCTION:
        return list(found)
    told: List[Explained] = []
    request: Any = None
    for each in found:
        if each.sent:
            request = each.frame.message
        elif request:
            each = each._replace(parts=lines.decoder(line, False).explain(
                each.frame.raw, request))
            request = None
        told.append(each)
    return told


# -- parts to text --------------------------------------------------------------------------


def render(each: Explained, paint: Paint) -> str:
    """A line for the whole, and one for each part."""
    speaker = 'computer' if each.sent else 'board'
    raw = each.frame.raw
    said = paint(each.trouble, 'bad') if each.trouble else each.frame.text
    text = [f'{paint("from the " + speaker, speaker)}, {len(raw)} bytes: {said}']
    is_encoded = any(part.data != raw[part.start:part.end] for part in each.parts)
    if is_encoded:
        text.append(paint(f'  {"on the wire":25}{"decoded":25}', 'dim'))
    for part in each.parts:
        text += _render_part(part, raw, is_encoded, paint)
    return '\n'.join(text)


def _render_part(part: Part, raw: bytes, is_encoded: bool, paint: Paint) -> List[str]:
    wire, data = raw[part.start:part.end], part.data
    words = [_value(part), part.meaning, paint(part.error, 'bad')]
    text = []
    for at in range(0, max(len(wire), len(data), 1), _MOST_BYTES):
        columns = f'  {hexed(wire[at:at + _MOST_BYTES]):25}'
        if is_encoded:
            columns += f'{hexed(data[at:at + _MOST_BYTES]):25}'
        if not at:
            columns += f'{part.name:18}' + '  '.join(word for word in words if word)
        text.append(columns.rstrip())
    return text


def _value(part: Part) -> str:
    if part.value is None:
        return ''
    told = f'{_number(part.value)} {part.unit}'.rstrip()
    return told if part.raw == part.value else f'{told} (sent as {_number(part.raw)})'


def _number(value: Any) -> str:
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, tuple):
        return '[' + ' '.join(map(_number, value)) + ']'
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def as_dict(each: Explained) -> dict:
    """For a program."""
    raw = each.frame.raw
    return {
        'from': 'computer' if each.sent else 'board', 'frame': raw.hex(),
        'sound': not each.trouble, 'text': each.frame.text, 'error': each.trouble,
        'parts': [{'start': part.start, 'end': part.end, 'name': part.name,
                   'wire': raw[part.start:part.end].hex(), 'data': part.data.hex(),
                   'raw': _plain(part.raw), 'value': _plain(part.value), 'unit': part.unit,
                   'meaning': part.meaning, 'error': part.error} for part in each.parts]}


def _plain(value: Any) -> Any:
    """As JSON can have it: a number that is none, as a voltage may be, is a text."""
    if isinstance(value, (tuple, list)):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
