"""The sensor board, exactly: what it sent against what was published and counted."""
import math
import time

import by_definition as codec
from .boards import CLIFF
from .exact_car import COUNTED
from .field import BACK, RETURN, Field

FRAME_TIMEOUT = 0.05     # s: the default of the bridge
_PERIOD = 1.3            # s from one report of silence to the next, at most


def lost_frames(field: Field) -> None:
    """Gaps in SEQ, and frames that come twice."""
    row = field.row('data', 'lost and doubled frames are counted, each')
    field.calm()
    field.sensors.cliff()
    field.wait(lambda: field.robot.got['mcu/cliff'], 'the first frame')
    gaps = 0, 1, 0, 5, 200, 0, 254
    with field.counts(row, 'mcu', {'frames lost': sum(gaps), 'frames doubled': 4}):
        for gap in gaps:
            field.sensors.seq = (field.sensors.seq + gap) % 256
            field.sensors.cliff()
        for _ in range(4):
            field.sensors.write(2 * field.sensors.frame(0x55, b'known to nobody'))
        field.compare(field.sensors)


def damaged(field: Field) -> None:
    """Frames with one wrong byte, each among good ones."""
    row = field.row('data', COUNTED)
    field.calm()
    good = codec.mcu_frame(0x55, 0, bytes(range(16, 32)))
    wrong_crc = bytes((*good[:8], good[8] ^ 1, *good[9:]))
    with field.counts(row, 'mcu', {'checksum errors': 3, 'length errors': 3, 'framing errors': 6}):
        for bad in (wrong_crc, good[:-1] + b'\x04', b'\x77',
                    codec.mcu_frame(CLIFF, field.sensors.seq, b'12')):
            for _ in range(3):
                field.sensors.measure()
                field.sensors.write(bad)
                field.sensors.measure()
        field.compare(field.sensors)
    count = field.robot.got['mcu/status'][-1].message.crc_error_count
    wanted = int(field.diagnosed('mcu')[2]['checksum errors'])
    row.check(count == wanted, f'crc_error_count is {count}, in /diagnostics {wanted}')


def false_starts(field: Field) -> None:
    """A frame behind a false start waits until that is given up; its stamp does not."""
    row = field.row('stamps', 'a frame that waits behind a false start keeps the stamp of its read')
    for start in b'\x02', b'\x02\x60', b'\x02\x60\x55':
        field.calm()
        field.sensors.line.write(start)
        field.sensors.measure()
        statuses = field.robot.got['mcu/status']
        got = row.wait(lambda: [one for one in statuses if one.key], 'it is published')[0]
        row.check(len(start) == 1 or got.wall - got.stamp >= FRAME_TIMEOUT - 0.005,
                  f'stamped {got.wall - got.stamp:.4f} s before it arrived: as it was given up')


def silent(field: Field) -> None:
    """It talks, falls silent, and talks again."""
    row = field.row('presence', 'a silent sensor board: not connected, no old values, each second')
    says = field.row('presence', 'a board that falls silent is not OK in /diagnostics')
    field.calm()
    with field.talking():
        for link in ('mcu', 'arduino'):
            says.wait(lambda: 'silent' not in field.diagnosed(link)[1], f'{link} talks')
    field.compare(field.car, field.sensors)
    statuses = field.robot.got['mcu/status']
    last = [one for one in statuses if one.key][-1]
    row.wait(lambda: statuses[-3].wall > last.wall, 'three reports')
    reports = statuses[-3:]
    for one in reports:
        m = one.message
        row.check((m.connected, m.valid, m.vl53_1, m.vl53_2) == (False, False, 65535, 65535)
                  and all(map(math.isnan, (m.yaw, m.pitch, m.roll)))
                  and m.seq == last.message.seq, f'{m}')
    for before, after in zip(reports, reports[1:]):
        row.at_most(after.stamp - before.stamp, _PERIOD, 's', 'between two reports')
    for link in ('mcu', 'arduino'):
        says.wait(lambda: 'silent' in field.diagnosed(link)[1], f'{link} is silent')


def openings(field: Field) -> None:
    """Unplugged, and back under the same and under another name."""
    back = field.row(*BACK)
    for index in range(3):
        field.calm()
        field.mcu_line.unplug()
        field.let_pass(0.3)
        began = time.monotonic()
        field.mcu_line.plug(another_name=index > 0)
        field.flows('mcu/cliff', field.sensors.cliff, back)
        back.at_most(time.monotonic() - began, RETURN, 's', 'mcu')


SCENARIOS = lost_frames, damaged, false_starts, silent, openings
