"""Consistent Overhead Byte Stuffing: packets without a zero byte, so that a zero can end one.

Reference: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions
on Networking 7(2), 1999. A block is a code byte n, then n-1 bytes that are not zero, then a
zero that is left out; code 255 stands for 254 bytes and no zero.
"""
from typing import List, Optional, Tuple

_BLOCK = 254  # most bytes in one block


class CobsError(ValueError):
    """The bytes are no COBS encoding; the text says why."""


def encode(data: bytes) -> bytes:
    """`data` without zeros, a byte longer for every 254 begun; the ending 0x00 is not added."""
    out = bytearray()
    runs = bytes(data).split(b'\0')
    last = len(runs) - 1
    for index, run in enumerate(runs):
        while len(run) >= _BLOCK:
            out.append(_BLOCK + 1)
            out += run[:_BLOCK]
            run = run[_BLOCK:]
            if not run and index == last:
                return bytes(out)
        out.append(len(run) + 1)
        out += run
    return bytes(out)


def decode(encoded: bytes) -> bytes:
    """The inverse of `encode`.

    Raises:
        CobsError: a zero inside, a code that runs past the end, or no byte at all.
    """
    if not encoded:
        raise CobsError('no bytes')
    if 0 in encoded:
        raise CobsError('zero inside')
    decoded = undo(encoded)
    if decoded is None:
        raise CobsError('a code runs past the end')
    return decoded


def undo(encoded: bytes) -> Optional[bytes]:
    """`decode` for a decoder's inner loop, which knows that `encoded` has bytes and no zero.

    None where a code runs past the end: an exception would cost a bad packet more time than all
    the rest of it.
    """
    size = len(encoded)
    at = 0
    if size <= _BLOCK:
        # No block can be full, so each code byte's place is a left-out zero's: write it there.
        out = bytearray(encoded)
        while at < size:
            code = out[at]
            out[at] = 0
            at += code
        del out[0]
    else:
        out = bytearray()
        while at < size:
            code = encoded[at]
            out += encoded[at + 1:at + code]
            at += code
            if code <= _BLOCK and at < size:
                out.append(0)
    return bytes(out) if at == size else None


def trace(encoded: bytes) -> Tuple[bytes, List[int], int]:
    """What can be decoded, where each byte of it stands in `encoded`, and what is missing.

    A zero stands where the code byte is that tells of it. What is missing is the number of bytes
    by which the last code runs past the end.
    """
    out, places = bytearray(), []
    at = past = 0
    while at < len(encoded):
        code = encoded[at]
        run = encoded[at + 1:at + code]
        out += run
        places += range(at + 1, at + 1 + len(run))
        past = max(at + code - len(encoded), 0)
        at += max(code, 1)
        if code <= _BLOCK and at < len(encoded):
            out.append(0)
            places.append(at)
    return bytes(out), places, past
