"""Consistent Overhead Byte Stuffing: packets without a zero byte, so that a zero can end one.

Reference: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions
on Networking 7(2), 1999. A block is a code byte n, then n-1 bytes that are not zero, then a
zero that is left out; code 255 stands for 254 bytes and no zero.
"""
from typing import Optional

_BLOCK = 254  # most bytes in one block


def encode(data: bytes) -> bytes:
    """Encode `data`; the result has no zero byte and lacks the 0x00 that ends a packet.

    It is 1 to 1 + len(data) // 254 bytes longer than `data`.
    """
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


def decode_or_none(encoded: bytes) -> Optional[bytes]:
    """The inverse of `encode`, for bytes that are not empty and have no zero.

    None: a code runs past the end. (Raising an exception would take longer than the decoding.)
    """
    size = len(encoded)
    at = 0
    if size <= _BLOCK:
        # No block can be full, so every code byte but the first stands where a zero was.
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
