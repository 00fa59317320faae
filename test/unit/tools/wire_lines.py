"""What the tests of `wire` share: vectors, damaged streams, and the settings of a link."""
import random

from decoding import vectors
from serial_communication.boards import description
from serial_communication.simulation.faults import Faults, parse
from serial_communication.tools.wire.lines import Settings

LINKS = ('bus', 'arduino', 'mcu')


BUS = vectors('robot_ctrl_bus')
# Frames of both directions.
FRAMES = {link: [bytes.fromhex(case[key]) for case in cases] for link, key, cases in (
    ('bus', 'frame', BUS['requests'] + BUS['replies']),
    ('mcu', 'frame', vectors('mcu')['frames']), ('arduino', 'wire', vectors('arduino')['packets']))}


def damaged_stream(link, seed, count):
    """The frames of a link on a line with faults."""
    chance = random.Random(f'{link} {seed}')
    faults = Faults(parse('drop=0.01 cut=0.03 lose=0.03 flip=0.03 insert=0.03 double=0.02'), seed)
    return b''.join(faults.damaged(chance.choice(FRAMES[link])) for _ in range(count))


def settings(link):
    """A link's settings by default."""
    board = description(link)
    return Settings(board, board.baud)
