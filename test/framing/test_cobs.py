"""COBS: the vectors, and an encoder written from the definition to compare with."""
import pytest
from by_definition import cobs_encode
from hypothesis import given
from hypothesis import strategies as st

from protocol_cases import hexed, vectors
from serial_communication.framing import cobs

VECTORS = vectors('cobs')

# Bytes among which zeros and long stretches without one are both common.
texts = st.one_of(
    st.binary(max_size=600),
    st.lists(st.tuples(st.sampled_from((0, 1, 253, 254, 255, 508, 509)), st.booleans()),
             max_size=4).map(lambda runs: b''.join(b'\x5a' * size + b'\0' * zero
                                                   for size, zero in runs)))


@pytest.mark.parametrize('pair', VECTORS['pairs'], ids=lambda pair: pair['decoded'][:20])
def test_vectors_both_ways(pair):
    decoded, encoded = hexed(pair['decoded']), hexed(pair['encoded'])
    assert cobs.encode(decoded) == encoded
    assert cobs.decode(encoded) == decoded
    assert cobs_encode(decoded) == encoded


@pytest.mark.parametrize('case', VECTORS['rejected'], ids=lambda case: case['name'])
def test_rejected_vectors(case):
    with pytest.raises(cobs.CobsError):
        cobs.decode(hexed(case['encoded']))


@pytest.mark.parametrize('encoded', [b'', b'\0', b'\2', b'\xff' + b'\1' * 253,
                                     b'\xff' + b'\1' * 254 + b'\2', b'\1' * 300 + b'\3\1'])
def test_what_is_no_encoding_is_refused_at_any_size(encoded):
    with pytest.raises(cobs.CobsError):
        cobs.decode(encoded)


@given(texts)
def test_round_trip(data):
    encoded = cobs.encode(data)
    assert encoded == cobs_encode(data)
    assert 0 not in encoded
    assert len(encoded) <= len(data) + 1 + len(data) // 254
    assert cobs.decode(encoded) == data


@given(st.binary(min_size=1, max_size=600))
def test_any_bytes_decode_to_what_encodes_back_or_are_refused(encoded):
    try:
        decoded = cobs.decode(encoded)
    except cobs.CobsError:
        return
    # A full block at the very end may be followed by a needless code byte.
    assert cobs.encode(decoded) in (encoded, encoded[:-1])


@given(st.lists(st.integers(1, 255), min_size=1, max_size=400))
def test_the_two_ways_of_decoding_agree(codes):
    """Short and long inputs take different paths: a prefix of a long one says the same."""
    long = cobs.encode(bytes(codes) + b'\0' + b'\7' * 300)
    short = cobs.encode(bytes(codes))
    assert cobs.decode(long).startswith(cobs.decode(short) + b'\0')
