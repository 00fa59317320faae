"""The sensor board, exactly: compares what it sent with what was published and counted."""
import math
import time

import by_definition as codec
from .boards import CLIFF
from .rig import ERRORS_COUNTED, PORT_RETURN, PORT_RETURNS, Rig

FRAME_TIMEOUT = 0.05     # s: the bridge's default
_REPORT_PERIOD = 1.3     # s at most between two reports of a silent board


def lost_frames(rig: Rig) -> None:
    """Gaps in SEQ, and doubled frames."""
    required = rig.require('data', 'every lost and every doubled frame is counted')
    rig.settle()
    rig.sensors.cliff()
    rig.wait(lambda: rig.robot.published['mcu/cliff'], 'the first frame')
    gaps = 0, 1, 0, 5, 200, 0, 254
    with rig.counted(required, 'mcu', {'frames lost': sum(gaps), 'frames doubled': 4}):
        for gap in gaps:
            rig.sensors.seq = (rig.sensors.seq + gap) % 256
            rig.sensors.cliff()
        for _ in range(4):
            rig.sensors.write(2 * rig.sensors.frame(0x55, b'of an unknown type'))
        rig.compare(rig.sensors)


def damaged(rig: Rig) -> None:
    """Invalid frames, each between two valid ones."""
    required = rig.require(*ERRORS_COUNTED)
    rig.settle()
    valid = codec.mcu_frame(0x55, 0, bytes(range(16, 32)))
    wrong_crc = bytes((*valid[:8], valid[8] ^ 1, *valid[9:]))
    wanted = {'checksum errors': 3, 'length errors': 3, 'framing errors': 6}
    with rig.counted(required, 'mcu', wanted):
        for invalid in (wrong_crc, valid[:-1] + b'\x04', b'\x77',
                        codec.mcu_frame(CLIFF, rig.sensors.seq, b'12')):
            for _ in range(3):
                rig.sensors.measure()
                rig.sensors.write(invalid)
                rig.sensors.measure()
        rig.compare(rig.sensors)
    count = rig.robot.published['mcu/status'][-1].message.crc_error_count
    wanted = int(rig.next_report('mcu')[2]['checksum errors'])
    required.check(count == wanted, f'crc_error_count is {count}, in /diagnostics {wanted}')


def false_starts(rig: Rig) -> None:
    """A frame after a false start is published when that times out, with an earlier stamp."""
    required = rig.require('stamps', 'a frame after a false start keeps the stamp of its read')
    for start in b'\x02', b'\x02\x60', b'\x02\x60\x55':
        rig.settle()
        rig.sensors.line.write(start)
        rig.sensors.measure()
        statuses = rig.robot.published['mcu/status']
        status = required.wait(lambda: [each for each in statuses if each.key], 'the status')[0]
        required.check(len(start) == 1 or status.wall - status.stamp >= FRAME_TIMEOUT - 0.005,
                       f'stamped only {status.wall - status.stamp:.4f} s before it arrived')


def silent(rig: Rig) -> None:
    """The boards send, and fall silent."""
    reported = rig.require('presence', 'a silent sensor board: reports each second, no old values')
    diagnosed = rig.require('presence', 'a silent board is not OK in /diagnostics')
    rig.settle()
    with rig.measuring():
        for link in ('mcu', 'arduino'):
            diagnosed.wait(lambda: 'silent' not in rig.next_report(link)[1], f'{link} sends')
    rig.compare(rig.car, rig.sensors)
    statuses = rig.robot.published['mcu/status']
    last = [each for each in statuses if each.key][-1]
    reported.wait(lambda: statuses[-3].wall > last.wall, 'three reports')
    reports = statuses[-3:]
    for each in reports:
        m = each.message
        reported.check((m.connected, m.valid, m.vl53_1, m.vl53_2) == (False, False, 65535, 65535)
                       and all(map(math.isnan, (m.yaw, m.pitch, m.roll)))
                       and m.seq == last.message.seq, f'{m}')
    for before, after in zip(reports, reports[1:]):
        reported.at_most(after.stamp - before.stamp, _REPORT_PERIOD, 's', 'between two reports')
    for link in ('mcu', 'arduino'):
        diagnosed.wait(lambda: 'silent' in rig.next_report(link)[1], f'{link} is silent')


def openings(rig: Rig) -> None:
    """The board is unplugged, and plugged in under the same name or another one."""
    required = rig.require(*PORT_RETURNS)
    for index in range(3):
        rig.settle()
        rig.mcu_line.unplug()
        rig.sleep(0.3)
        began = time.monotonic()
        rig.mcu_line.plug(another_name=index > 0)
        rig.wait_for_data('mcu/cliff', rig.sensors.cliff, required)
        required.at_most(time.monotonic() - began, PORT_RETURN, 's', 'mcu')


SCENARIOS = lost_frames, damaged, false_starts, silent, openings
