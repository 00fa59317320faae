"""What the tests of `wire` share: vectors, damaged streams, and the settings of a link."""
import json
from pathlib import Path
import os
import random

from serial_communication.boards import description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.simulation.faults import Faults, parse
from serial_communication.tools.wire.lines import Settings

ROOT = str(Path(__file__).resolve().parents[3])
LINKS = ('bus', 'arduino', 'mcu')


def vectors(protocol):
    """The byte-exact vectors of one protocol."""
    path = os.path.join(ROOT, 'test', 'unit', 'boards', 'vectors', protocol + '.json')
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
        arduino.Imu(16384, 0, 0, 0, *[number] * 7), arduino.LOGS[2]('motor hot' * (number % 5)))))


def damaged_stream(link, seed, count):
    """The bytes of a board on a line with faults."""
    chance = random.Random(f'{link} {seed}')
    faults = Faults(parse('drop=0.01 cut=0.03 lose=0.03 flip=0.03 insert=0.03 double=0.02'), seed)
    return b''.join(faults.damaged(valid_frame(link, chance)) for _ in range(count))


def settings(link):
    """A link's settings by default."""
    board = description(link)
    return Settings(board, board.baud)
