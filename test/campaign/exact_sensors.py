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
    required = rig.row('every lost and every doubled frame is counted')
    rig.settle()
    rig.sensors.cliff()
    rig.wait(lambda: rig.robot.published['mcu/cliff'], 'the first frame')
    gaps = 0, 1, 0, 5, 200, 0, 254
    with rig.counted(required, 'mcu', {'frames lost': sum(gaps), 'frames doubled': 8}):
        for gap in gaps:
            rig.sensors.seq = (rig.sensors.seq + gap) % 256
            rig.sensors.cliff()
        for _ in range(4):
            rig.sensors.write(2 * rig.sensors.frame(0x55, b'of an unknown type'))
            rig.sensors.cliff()
            rig.sensors.line.write(rig.sensors.written[-1])     # the same again
        rig.compare(rig.sensors)


def damaged(rig: Rig) -> None:
    """Invalid frames, each between two valid ones."""
    required = rig.row(ERRORS_COUNTED)
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
    required = rig.row('a frame after a false start keeps the stamp of its read')
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
    reported = rig.row('a silent sensor board: reports each second, no old values')
    rig.settle()
    rig.car.talks = False
    with rig.clock.each(0.05, rig.measure):
        for link in ('mcu', 'arduino'):
            rig.diagnosed(link, 0, 'open')
    rig.sleep(0.05)         # until the last call has returned
    rig.compare(rig.car, rig.sensors)
    statuses, adc = rig.robot.published['mcu/status'], rig.robot.published['mcu/adc_status']
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
        ages = before.message.last_frame_age_sec, after.message.last_frame_age_sec
        reported.check(ages[0] < ages[1], f'ages {ages}')
    m = adc[-1].message
    reported.check(adc[-1].key is None and {getattr(m, f'adc{n}') for n in range(6)} == {65535}
                   and not m.connected and not m.valid, f'{m}')
    for link in ('mcu', 'arduino'):
        rig.diagnosed(link, 1, 'silent')
    rig.car.talks = True


def dribble(rig: Rig) -> None:
    """A false start, and a byte each 30 ms between good frames."""
    for _ in range(3):
        rig.settle()
        rig.mcu_line.write(b'\x02\xFF\x55')
        for _ in range(20):
            rig.mcu_line.write(b'\x11')
            rig.sensors.measure()
            rig.sleep(0.03)
        rig.compare(rig.sensors)


def openings(rig: Rig) -> None:
    """The board is unplugged, and plugged in under the same name or another one."""
    required = rig.row(PORT_RETURNS)
    for index in range(3):
        rig.settle()
        rig.mcu_line.unplug()
        rig.sleep(0.3)
        if not index:
            rig.diagnosed('mcu', 2, 'closed')
        with rig.counted(rig.row('the counters in /diagnostics are exact'), 'mcu',
                         {'reconnects': 1}):
            began = time.monotonic()
            rig.mcu_line.plug(another_name=index > 0)
            rig.wait_for_data('mcu/cliff', rig.sensors.cliff, required)
            ended = time.monotonic()
        required.at_most(ended - began, PORT_RETURN, 's', 'mcu')


SCENARIOS = lost_frames, damaged, false_starts, dribble, silent, openings
