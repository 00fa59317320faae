"""COBS: the vectors, and a comparison with an encoder written from the definition."""
import pytest
from by_definition import cobs_encode
from hypothesis import given
from hypothesis import strategies as st

from decoding import hexed, vectors
from serial_communication.framing import cobs

VECTORS = vectors('cobs')

# Data in which both zeros and long runs without a zero are common.
any_data = st.one_of(
    st.binary(max_size=600),
    st.lists(st.tuples(st.sampled_from((0, 1, 253, 254, 255, 508, 509)), st.booleans()),
             max_size=4).map(lambda runs: b''.join(b'\x5a' * size + b'\0' * zero
                                                   for size, zero in runs)))


@pytest.mark.parametrize('pair', VECTORS['pairs'], ids=lambda pair: pair['decoded'][:20])
def test_vectors_encode_and_decode(pair):
    decoded, encoded = hexed(pair['decoded']), hexed(pair['encoded'])
    assert cobs.encode(decoded) == encoded
    assert cobs.decode_or_none(encoded) == decoded
    assert cobs_encode(decoded) == encoded


REJECTED = [hexed(case['encoded']) for case in VECTORS['rejected']]


@pytest.mark.parametrize('encoded', [
    *filter(lambda encoded: encoded and 0 not in encoded, REJECTED), b'\2',
    b'\xff' + b'\1' * 253, b'\xff' + b'\1' * 254 + b'\2', b'\1' * 300 + b'\3\1'])
def test_an_invalid_encoding_is_rejected_at_any_size(encoded):
    """An empty packet, or one with a zero, cannot come out of a decoder, which splits at zeros."""
    assert cobs.decode_or_none(encoded) is None


@given(any_data)
def test_decoding_reverses_encoding(data):
    encoded = cobs.encode(data)
    assert encoded == cobs_encode(data)
    assert 0 not in encoded
    assert len(encoded) <= len(data) + 1 + len(data) // 254
    assert cobs.decode_or_none(encoded) == data
