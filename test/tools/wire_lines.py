"""What the tests of `wire` share: damaged streams, and what a link decodes from them."""
import json
import os
import random

from serial_communication.boards import description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.simulation.faults import Faults, parse
from serial_communication.tools.wire.lines import Direction, Settings
from serial_communication.tools.wire.recording import Read, RecordedFrame, Recording, frames_of

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
LINKS = ('bus', 'arduino', 'mcu')


class Target:
    """A board to which any fault may be applied."""

    NAME, FAULTS, READS = 'any', '', True


def vectors(protocol):
    """The byte-exact vectors of one protocol."""
    path = os.path.join(ROOT, 'test', 'boards', 'vectors', protocol + '.json')
    with open(path, encoding='utf-8') as file:
        return json.load(file)


def valid_frame(link, chance):
    """A random frame of a board."""
    number = chance.randrange(256)
    if link == 'bus':
        data = bytes(chance.randrange(256) for _ in range(chance.choice((0, 0, 2, 6, 6, 40))))
        return bus.encode_reply(bus.Reply(chance.choice((0, 1, 2, 2, 2, 3)), data))
    if link == 'mcu':
        return mcu.encode(mcu.SensorStatus(chance.randrange(3000), 0xFFFF, number, 3.0, -2.0),
                          number)
    return arduino.encode(chance.choice((
        arduino.Ticks(number), arduino.SteeringAngle(number * 5), arduino.Voltage(number / 20),
        arduino.Imu(16384, 0, 0, 0, *[number] * 7), arduino.Log(2, 'motor hot' * (number % 5)))))


FAULTS = ('drop=0.01', 'cut=0.03', 'lose=0.03', 'flip=0.03', 'insert=0.03', 'double=0.02')
PERIODS = {'bus': 0.06, 'arduino': 0.01, 'mcu': 0.05}     # s, from frame to frame


def damaged_reads(link, seed, count=150):
    """Reads of a board on a line with faults, at the board's rate.

    Sometimes a frame is split between two reads, several frames are in one late read, or the board
    is silent for a while.
    """
    chance = random.Random(f'{link} {seed}')
    faults = Faults(parse(FAULTS, Target), seed)
    reads, waiting, due = [], b'', 0.0
    for _ in range(count):
        due += PERIODS[link]
        at = due + chance.uniform(0.0, 0.0008)
        waiting += faults.sent(valid_frame(link, chance), at).wire
        case = chance.random()
        if case < 0.03:
            continue                    # the next frame is in the same read
        if case < 0.05:
            due += chance.choice((0.07, 0.5))
        if case > 0.9 and len(waiting) > 1:
            size = chance.randrange(1, len(waiting))
            reads.append(Read(at, False, waiting[:size]))
            at, waiting = at + 0.001, waiting[size:]
        if waiting:
            reads.append(Read(at, False, waiting))
            waiting = b''
    return reads


def decoded(reads, line):
    """The frames that a link decodes from reads, and its counts of errors."""
    direction = Direction(line, False)
    frames = []
    for read in reads:
        frames += direction.feed(read.data, read.at)
    return frames + direction.expire(float('inf')), dict(direction.decoder.errors)


def as_bag(reads, line):
    """The bag of these reads: frames without their messages."""
    return Recording(0.0, {}, [RecordedFrame(line.link, False, frame._replace(message=None))
                               for frame in decoded(reads, line)[0]])


def from_board(recording, line):
    """The frames of a recording that the board sent."""
    return [each.frame for each in frames_of(recording, line) if not each.sent]


def settings(link):
    """A link's settings by default."""
    board = description(link)
    return Settings(board, board.baud)
