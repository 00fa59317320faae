"""Hypothesis strategies for rows of custom messages, and an encoder that is not the package's."""
import struct
from typing import Any, List

from hypothesis import strategies as st

_CODES = 'bBhHiIlLqQefd?'
_SIZES = {'b': 1, 'B': 1, 'h': 2, 'H': 2, 'i': 4, 'I': 4, 'l': 4, 'L': 4, 'q': 8, 'Q': 8}


def encoded(layout: str, raws: List[Any]) -> bytes:
    """The bytes of these raw numbers and texts.

    `layout` has single characters and a last ``*`` or ``s``, but no counts and no padding.
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
    """Strategy: a number of one of struct's codes."""
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
def layout_and_raws(draw):
    """Strategy: a valid layout, and raw numbers for it."""
    codes = draw(st.lists(st.sampled_from(_CODES), max_size=6))
    layout, raws = draw(st.sampled_from('<>')) + ''.join(codes), [draw(numbers(c)) for c in codes]
    ending = draw(st.sampled_from(('', '*', 's')))
    if ending == '*':
        code = draw(st.sampled_from(_CODES))
        layout += code + '*'
        raws.append(draw(st.lists(numbers(code), max_size=5)))
    elif ending == 's':
        layout += 's'
        raws.append(draw(_TEXTS))
    return layout, raws
