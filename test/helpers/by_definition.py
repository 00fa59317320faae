"""Parts of the protocols written from their definitions, for tests to compare the package with."""


def xor_of(data: bytes) -> int:
    """The XOR of every byte."""
    value = 0
    for byte in data:
        value ^= byte
    return value


def cobs_encode(data: bytes) -> bytes:
    """The COBS encoding, without the 0x00 that ends a packet."""
    out, block = bytearray(), bytearray()
    for index, byte in enumerate(data):
        if byte:
            block.append(byte)
        # A full block at the end needs no block after it.
        if not byte or len(block) == 254 and index + 1 < len(data):
            out.append(len(block) + 1)
            out += block
            block.clear()
    out.append(len(block) + 1)
    return bytes(out + block)
