"""A board of another package, for the tests of `wire`: a crane scale."""
from serial_communication.boards.description import Description
from serial_communication.framing.row_reader import Group
from serial_communication.framing.rows import Kind

from . import wire


def _decoder(sent, parameters):
    return wire.Decoder([row.message for row in DESCRIPTION.read_all(parameters)])


DESCRIPTION = Description(
    'scale', __name__, _decoder,
    groups=(Group('messages', 'scale/', (Kind.FROM,), range(3, 16), 8),),
    longest_gap=0.2, baud=9600, between=b'\n')
