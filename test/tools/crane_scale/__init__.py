"""A board of another package, for the tests of `wire`: a crane scale."""
from serial_communication.boards.description import CustomRows, Description, Heartbeat
from serial_communication.framing.custom_messages import read_messages

from . import wire


def custom_messages(entries):
    """Return the messages of ``scale/messages``."""
    return read_messages(entries, 'scale/messages', range(3, 16), 8)


def _decoder(sent, parameters):
    return wire.Decoder([each.kind for each in custom_messages(parameters.get('messages') or {})])


DESCRIPTION = Description(
    'scale', __name__, _decoder, custom=CustomRows('messages', custom_messages, 'scale/'),
    heartbeat=Heartbeat(wire.Hold.TYPE, longest_gap=0.2), baud=9600, between=b'\n')
