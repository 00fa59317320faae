"""Any row of a message of one's own, and an encoder that shares no code with the package's."""
import math
import struct
from typing import Any, List

from hypothesis import strategies as st

_SIZES = {'b': 1, 'B': 1, 'h': 2, 'H': 2, 'i': 4, 'I': 4, 'l': 4, 'L': 4, 'q': 8, 'Q': 8}


def encoded(layout: str, raws: List[Any]) -> bytes:
    """The bytes of these raw numbers and texts, one value after the other.

    `layout` has single characters, and a last ``*`` or ``s``; no padding.
    """
    order = 'little' if layout[0] == '<' else 'big'
    data, codes = b'', layout[1:].replace('*', '')
    for code, raw in zip(codes, raws):
        for number in raw if isinstance(raw, list) else [raw]:
            if code == 's':
                data += number.encode()
            elif code == '?':
                data += b'\1' if number else b'\0'
            elif code in _SIZES:
                data += int(number).to_bytes(_SIZES[code], order, signed=code.islower())
            else:
                bits = struct.pack('<' + code, number)
                data += bits if order == 'little' else bits[::-1]
    return data


def numbers(code: str) -> Any:
    """Numbers of one code."""
    if code == '?':
        return st.booleans()
    if code in _SIZES:
        bits = 8 * _SIZES[code]
        low = -2 ** (bits - 1) if code.islower() else 0
        return st.one_of(st.sampled_from((low, low + 2 ** bits - 1)),
                         st.integers(low, low + 2 ** bits - 1))
    return st.floats(width={'e': 16, 'f': 32, 'd': 64}[code], allow_nan=False)


_TEXTS = st.text(st.characters(blacklist_characters='\0', blacklist_categories=('Cs',)),
                 max_size=20)


@st.composite
def row_and_raws(draw, codes='bBhHiIlLqQefd?', fields=None, scaled=True):
    """A valid entry of arduino/messages, and raw numbers for it."""
    chosen = draw(st.lists(st.sampled_from(codes), max_size=6))
    layout, raws = draw(st.sampled_from('<>')) + ''.join(chosen), [draw(numbers(c)) for c in chosen]
    ending = draw(st.sampled_from(('', '*', 's')))
    if ending == '*':
        code = draw(st.sampled_from(codes))
        layout += code + '*'
        raws.append(draw(st.lists(numbers(code), max_size=5)))
    elif ending == 's':
        layout += 's'
        raws.append(draw(_TEXTS))
    paths = [draw(st.sampled_from((f'field{index}', f'list[{index}]', f'a.b{index}', '')))
             for index in range(len(raws))]
    scale = draw(st.sampled_from((1, 1, 0.01, -0.5, 3))) if scaled else 1
    offset = draw(st.sampled_from((0, 0, -40, 1.5))) if scaled else 0
    return dict(type=draw(st.integers(13, 255)), ros_type='any/Type', layout=layout,
                fields=paths, scale=scale, offset=offset), raws


def same(one: Any, other: Any) -> bool:
    """Equal, or both no number."""
    return one == other or (isinstance(one, float) and math.isnan(one) and math.isnan(other))
