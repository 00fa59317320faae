"""Data, exactly: compares what the boards sent with what was published, counted and shown."""
import contextlib
import itertools
import math
import os
import struct
import termios
import time
from collections import defaultdict
from typing import Dict, List, Tuple

import by_definition as codec
from processes import StageError
from serial_communication.msg import SerialMsg
from .boards import ALIVE, BLOB, CLIFF, COUNTER, TIMED
from .exact_car import Drive
from .rig import MOUNT, NOISE, UNTIL_PUBLISHED, Rig

REPORTED = 'a silent sensor board: reports each second, no old values'
_COUNTED = 'the counters in /diagnostics are exact'
_FRAME_TIMEOUT = 0.05    # s: the bridge's default
_REPORT_PERIOD = 1.3     # s at most between two reports of a silent board
_SILENT_AFTER = 0.9      # s at least until the first report, and between two
_AGE_OFF = 0.1           # s by which the age in a report may be off
_TIME = 254              # the type of the board's time
_TIMES, _EACH = 300, 0.01       # measurements with it, and s between two
_UNMOUNTED = 'base_link', 0.0, 0.0, 0.0, 1.0, 0.0
_MOUNTS = {'imu': _UNMOUNTED, 'mcu_imu': _UNMOUNTED, 'range_1': _UNMOUNTED, 'range_2': (
    'base_link', *MOUNT[:3], round(math.cos(MOUNT[5] / 2), 6), round(math.sin(MOUNT[5] / 2), 6))}
_KNOWN = 200             # measurements until the bridge knows the clock; twice what it says
_WITHIN = 0.005          # s from the measurement
_RATE = 1.003e6          # ticks of the board's clock in a second
_VALID = codec.mcu_frame(0x55, 0, bytes(range(16, 32)))
_FALSE_START = b'\x02\xFF\x55'
_UNKNOWN = codec.arduino_packet(200, b'abc')
_NO_ROTATION = struct.pack('>11h', 17367, *[0] * 10)      # its quaternion has the norm 1.06
# Invalid bytes, and the counter of each; each comes between valid frames.
DAMAGE = {
    'arduino': (
        ('framing errors', b'\x09\x01\x02\x00'),
        ('length errors', codec.arduino_packet(codec.TICKS, b'\1\2')),
        ('unknown type errors', _UNKNOWN),
        ('implausible errors', codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', 100.5))),
        ('implausible errors', codec.arduino_packet(codec.IMU, _NO_ROTATION)),
        ('implausible errors', codec.arduino_packet(codec.STEERING_ANGLE, b'\x01\x04')),
        ('oversize errors', b'\x01' * 300 + b'\0')),
    'mcu': 3 * (
        ('checksum errors', bytes((*_VALID[:8], _VALID[8] ^ 1, *_VALID[9:]))),
        ('framing errors', _VALID[:-1] + b'\x04'), ('framing errors', b'\x77'),
        ('length errors', codec.mcu_frame(CLIFF, 0, b'12')))}


def at_rest(rig: Rig) -> None:
    """The heartbeats of 5 s, what /diagnostics counts of them, the mounts, and the car's texts."""
    not_sent = _count_beats(rig)
    began, beats = time.monotonic(), rig.car.all_beats
    rig.wait_beats(5.0)
    seconds, beats = time.monotonic() - began, rig.car.all_beats - beats
    rig.row('heartbeats: 100 a second').check(
        abs(beats / seconds - 100) < 2, f'{beats} in {seconds:.3f} s')
    not_sent -= _count_beats(rig)
    rig.row(_COUNTED).check(abs(not_sent) < 30, f'heartbeats sent: {not_sent} off')
    rig.row('the mounts of the parameters are on /tf_static').check(
        rig.robot.mounts == _MOUNTS, f'{rig.robot.mounts}')
    for severity in range(4):
        rig.car.write(codec.arduino_packet(severity, b'text %d\0' % severity))


def measurements(rig: Rig) -> None:
    """All types of messages of the car and the sensor board."""
    for number in range(25):
        rig.measure()
        rig.sensors.cliff()
        if number < 10:     # with the type 247 … 256 bytes
            size = 246 + number
            rig.car.send(codec.arduino_packet(BLOB, bytes(1 + n % 255 for n in range(size))))
        rig.wait_beats(0.05)
    rig.compare(rig.car, rig.sensors)


def _count_beats(rig: Rig) -> int:
    """How many more heartbeats were received than /diagnostics says are sent."""
    sent = int(rig.next_report('arduino')[2]['heartbeats sent'])
    return rig.car.all_beats - sent


def damaged(rig: Rig) -> None:
    """Invalid frames, each between valid ones; noise before a frame; a false start, and then a byte
    each 30 ms between frames."""
    required = rig.row('every error is counted by cause and costs no valid frame')
    before = _unknown_types(rig)        # in the first 5 s of a connection they do not count
    rig.wait(lambda: _unknown_types(rig) > before or not rig.car_line.write(_UNKNOWN), 'one counts')
    for link, board in rig.tries(('arduino', rig.car), ('mcu', rig.sensors)):
        keys = [key for key, _data in DAMAGE[link]]
        with rig.counted(required, link, {key: keys.count(key) for key in keys}):
            for _key, data in DAMAGE[link]:
                board.measure()
                # A length error of the sensor board has the SEQ of the frame before it.
                board.line.write(data if data[:1] != b'\x02' else codec.mcu_frame(
                    CLIFF, rig.sensors.seq, b'12') if data[2] == CLIFF else data)
                board.measure()
            rig.diagnosed(link, 1, 'errors in the last second')
            rig.compare(board)
    count = rig.robot.published['mcu/status'][-1].message.crc_error_count
    wanted = rig.next_report('mcu')[2]['checksum errors']
    adc = rig.robot.values('mcu/adc_status')[-1].message.crc_error_count
    required.check(str(count) == str(adc) == wanted,
                   f'crc_error_count is {count} and {adc}, in /diagnostics {wanted}')
    for _ in rig.tries(*range(3)):
        for board, end in (rig.car, b'\0'), (rig.sensors, b''):
            board.line.write(NOISE + end)
            board.measure()
        # A frame inside another one, whose CRC does not match.
        rig.mcu_line.write(b'\x02\x0C\x55\0')
        rig.sensors.cliff()
        rig.mcu_line.write(b'\0\x03')
        rig.mcu_line.write(_FALSE_START)
        for _ in range(20):
            rig.mcu_line.write(b'\x11')
            rig.sensors.measure()
            rig.sleep(0.03)
        rig.compare(rig.car, rig.sensors)


def _unknown_types(rig: Rig) -> int:
    return int(rig.next_report('arduino')[2]['unknown type errors'])


def lost_frames(rig: Rig) -> None:
    """Gaps in SEQ, and doubled frames."""
    rig.sensors.cliff()
    rig.wait(lambda: rig.robot.published['mcu/cliff'], 'the first frame')
    gaps = 0, 1, 0, 5, 200, 0, 254
    with rig.counted(rig.row('every lost and every doubled frame is counted'), 'mcu',
                     {'frames lost': sum(gaps), 'frames doubled': 8}):
        for gap in gaps:
            rig.sensors.seq = (rig.sensors.seq + gap) % 256
            rig.sensors.cliff()
        for _ in range(4):
            rig.sensors.write(2 * rig.sensors.frame(0x55, b'of an unknown type'))
            rig.sensors.cliff()
            rig.sensors.line.write(rig.sensors.written[-1])     # the same again
        rig.compare(rig.sensors)


def false_starts(rig: Rig) -> None:
    """A frame after a false start is published when that times out, with an earlier stamp."""
    required = rig.row('a frame after a false start keeps the stamp of its read')
    for start in rig.tries(b'\x02', b'\x02\x60', b'\x02\x60\x55'):
        rig.sensors.line.write(start)
        rig.sensors.measure()
        status = required.wait(lambda: rig.robot.values('mcu/status'), 'the status')[0]
        required.check(len(start) == 1 or status.wall - status.stamp >= _FRAME_TIMEOUT - 0.005,
                       f'stamped only {status.wall - status.stamp:.4f} s before it arrived')


def traffic(rig: Rig) -> None:
    """What serial_msg and /diagnostics show, compared with the frames on the lines."""
    required = rig.row('serial_msg has every received and sent frame once, in order')
    counters, drive = rig.row(_COUNTED), Drive(rig)
    shown: Dict[Tuple[str, int], List[SerialMsg]] = defaultdict(list)   # by link and direction
    subscriber = rig.robot.subscribe_to_traffic(
        lambda message: shown[message.link, message.direction].append(message))
    # Until each link has shown frames.
    required.wait(lambda: not rig.measure() and rig.robot.call('bus/echo').success
                  and len(shown) >= 5, 'serial_msg shows frames of all links')
    rig.settle()
    wanted = {'frames received': 40, 'framing errors': 20, 'checksum errors': 0,
              'bytes received': 0}
    began = time.time() - 0.1
    with rig.counted(counters, 'mcu', wanted):
        rig.clear_records()
        for number in range(1, 21):
            rig.measure()
            rig.sensors.write(codec.mcu_frame(0x55, number, b'damaged')[:-1] + b'!')
            drive.command('steering')
            rig.robot.call('bus/echo')
        rig.sleep(0.1)      # a damaged frame is given up
        wanted['bytes received'] = len(b''.join(rig.sensors.written))
    for link, direction, frames, frame_at in (
            ('arduino', 1, [codec.arduino_packet(each.type, each.data) for each in rig.car.packets],
             codec.arduino_at),
            ('bus', 1, [codec.bus_frame(bytes((each.cmd1, each.cmd2)), each.data)
                        for each in rig.bus.requests], codec.request_at),
            *((board.line.name, 0, board.written, board.sent_frame_at)
              for board in (rig.car, rig.sensors, rig.bus))):
        frames = [frame for frame in frames         # signs of life are all the same
                  if b'damaged' not in frame and frame != codec.arduino_packet(ALIVE)]

        def found() -> List[SerialMsg]:
            return [each for each in list(shown[link, direction]) if bytes(each.frame) in frames]
        with contextlib.suppress(StageError):
            rig.wait(lambda: len(found()) >= len(frames), '', UNTIL_PUBLISHED)
        for each, frame in itertools.zip_longest(found(), frames):
            content = codec.decode(frame or b'', frame_at)[0]
            if required.check(
                    each and content and bytes(each.frame) == frame and content[0].content
                    == (each.type, each.command, bytes(each.data)) and each.text
                    and not each.error, f'{link} {direction}: {each}, not {frame!r}'):
                required.check(_is_described(each, began), f'{link} {direction}: {each}')
    errors = b''.join(bytes(each.frame) for each in shown['mcu', 0] if each.error)
    required.check(errors.count(b'damaged') == 20, 'not all damaged frames are shown')
    subscriber.unregister()
    for link, line in rig.lines.items():
        counters.check(rig.next_report(link)[2]['hardware id'] == line.port, f'port of {link}')


def _is_described(shown: SerialMsg, began: float) -> bool:
    """Whether the header and the text of a frame are right, for a time that began then."""
    is_counter = (shown.link, shown.type) == ('arduino', COUNTER)
    return (shown.header.frame_id.startswith('connection ')
            and began < shown.header.stamp.to_sec() < time.time() and (
                not is_counter
                or shown.text == f'counter data={int.from_bytes(shown.data, "little")}'))


def settings(rig: Rig) -> None:
    """Another program changes the settings of the port (stty icrnl)."""
    required = rig.row('changed settings of a tty are restored within 0.3 s')
    for _ in rig.tries(*range(2)):
        with open(rig.car_line.port, 'rb', buffering=0, opener=lambda path, flags: os.open(
                path, flags | os.O_NOCTTY | os.O_NONBLOCK)) as port:
            changed = termios.tcgetattr(port)
            changed[0] |= termios.ICRNL
            changed[3] |= termios.ECHO
            termios.tcsetattr(port, termios.TCSANOW, changed)
        rig.sleep(0.3)
        rig.clear_records()
        for _ in range(20):
            rig.car.send(codec.arduino_packet(codec.TICKS, b'\x0d'))
            rig.wait_beats(0.02)
        rig.compare(rig.car)
        echoed = [each for each in rig.car.packets if not each.is_stop]
        required.check(not echoed, f'{echoed[:3]} was echoed to the board')


def silent(rig: Rig) -> None:
    """The boards send, and fall silent."""
    reported = rig.row(REPORTED)
    rig.car.talks = False
    with rig.clock.each(0.05, rig.measure):
        for link in ('mcu', 'arduino'):
            rig.diagnosed(link, 0, 'open')
    rig.sleep(0.05)         # until the last call has returned
    rig.compare(rig.car, rig.sensors)
    statuses, adc = rig.robot.published['mcu/status'], rig.robot.published['mcu/adc_status']
    last = rig.robot.values('mcu/status')[-1]
    reported.wait(lambda: statuses[-3].wall > last.wall, 'three reports')
    ahead = time.time() - time.monotonic()
    for before, after in zip([last, *statuses[-3:]], statuses[-3:]):
        m = after.message
        reported.check((m.connected, m.valid, m.vl53_1, m.vl53_2) == (False, False, 65535, 65535)
                       and all(map(math.isnan, (m.yaw, m.pitch, m.roll)))
                       and m.seq == last.message.seq, f'{m}')
        rig.in_time(reported, before.stamp - ahead, after.stamp - ahead, _REPORT_PERIOD,
                    'from the last frame or report', _SILENT_AFTER)
        rig.in_time(reported, last.stamp - ahead, after.stamp - ahead,
                    m.last_frame_age_sec + _AGE_OFF, 'its age', m.last_frame_age_sec - _AGE_OFF)
    m, before = adc[-1].message, rig.robot.values('mcu/adc_status')[-1].message
    reported.check(m.seq == before.seq and len(adc) > 2 and adc[-2].key is None, f'{m}')
    reported.check(adc[-1].key is None and {getattr(m, f'adc{n}') for n in range(6)} == {65535}
                   and not m.connected and not m.valid, f'{m}')
    for link in ('mcu', 'arduino'):
        rig.diagnosed(link, 1, 'silent')
    rig.car.talks = True


def _send_with_time(rig: Rig, kind: int, batch: float, damaged: int, origin: int) -> List[float]:
    """Send TICKS behind TIME, or TIMED, which has the time itself. Return when each was measured,
    by time.time().

    Args:
        kind: TICKS or TIMED.
        batch: s; the bytes are sent at each multiple of it; 0.0: at once.
        damaged: each of so many times has no count. After 2.5 s all is held back for 0.2 s.
        origin: the board's clock at the beginning, in µs.
    """
    measured, began, ahead = [], time.monotonic(), time.time() - time.monotonic()
    for number in range(_TIMES):
        at = began + number * _EACH
        time.sleep(max(0.0, (math.ceil(at / batch) * batch if batch else at) - time.monotonic()))
        at = at if batch else time.monotonic()
        if number == _KNOWN + 50:
            time.sleep(0.2)
        board_time = struct.pack('<IB', round(origin + (at - began) * _RATE) % 2 ** 32, 1)
        value = bytes((number % 256,))
        rig.car.line.write(
            codec.arduino_packet(TIMED, board_time[:4] + value) if kind == TIMED else
            codec.arduino_packet(_TIME, board_time[:5 if number % damaged else 4])
            + codec.arduino_packet(codec.TICKS, value))
        measured.append(at + ahead)
    return measured


def stamps(rig: Rig) -> None:
    """A clock that drifts, wraps, and begins again elsewhere; batches, damage, a stall."""
    never = rig.row('a stamp is never after the read')
    within = rig.row("with the board's time a stamp is within 5 ms of the measurement")
    reads: List[float] = []
    topics = {codec.TICKS: '~ticks', TIMED: '~timed'}
    subscriber = rig.robot.subscribe_to_traffic(
        lambda frame: reads.append(frame.header.stamp.to_sec())
        if (frame.link, frame.direction) == ('arduino', 0) and frame.type in topics else None)
    rig.wait(lambda: rig.car.measure() or rig.wait_beats(0.02) or reads, 'serial_msg')
    for kind, batch, damaged, origin, stalls in (
            (codec.TICKS, 0.0, _TIMES, 2 ** 32 - 2_500_000, False),
            (codec.TICKS, 0.016, 7, 0, False), (TIMED, 0.016, _TIMES, 2 ** 31, True)):
        rig.settle()
        published = rig.robot.published[topics[kind]]
        if stalls:
            with rig.suspended():
                rig.sleep(0.5)
            rig.sleep(1.0)          # until nothing is dropped any more
        reads.clear()
        measured = _send_with_time(rig, kind, batch, damaged, origin)
        with contextlib.suppress(StageError):
            rig.wait(lambda: min(len(published), len(reads)) >= _TIMES, '', UNTIL_PUBLISHED)
        for number, (at, one, read) in enumerate(itertools.zip_longest(measured, published, reads)):
            if not never.check(at and one and read and one.key == number % 256,
                               f'{number} of {len(published)} and {len(reads)} is not published'):
                break
            text = f'{number}: measured {at:.4f}, read {read:.4f}, stamped {one.stamp:.4f}'
            never.check(one.stamp <= read + 1e-6, text)
            if not number % damaged and kind != TIMED:
                never.check(one.stamp == read, text)
            elif number >= _KNOWN:
                within.at_most(abs(one.stamp - at) * 1e3, _WITHIN * 1e3, 'ms', text)
    subscriber.unregister()


# The measurements are short, four times: on a busy machine a long scenario is stalled too often.
SERIAL = (at_rest, *4 * (measurements,), damaged, lost_frames, false_starts, traffic, settings,
          silent, stamps)
