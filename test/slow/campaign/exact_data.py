"""Data, exactly: compares what the boards sent with what was published, counted and shown."""
import itertools
import math
import os
import struct
import termios
import time
from collections import defaultdict
from typing import IO, Dict, List, NamedTuple, Tuple

import rospy
from roscpp.srv import SetLoggerLevel

import by_definition as codec
from serial_communication.msg import SerialMsg
from .witness import LATE
from .boards import ALIVE, BLOB, CLIFF, COUNTER, NOTE, TIMED
from .exact_car import Drive
from .rig import MOUNT, NOISE, PREFIX, PUBLISHED, UNTIL_PUBLISHED, Rig
from .robot import NODE

REPORTED = 'a silent sensor board: reports each second, no old values'
_COUNTED = 'the counters in /diagnostics are exact'
_FRAME_TIMEOUT = 0.05    # s: the bridge's default
_GIVEN_UP = 0.3          # s: it, the time of a frame on the wire, and what ROS may take
_REPORT_PERIOD = 1.3     # s at most between two reports of a silent board
_SILENT_AFTER = 0.9      # s at least until the first report, and between two
_AGE_OFF = 0.1           # s by which the age in a report may be off
_TIMES, _EACH = 300, 0.01       # values with it, and s between two
# In /tf_static: parent, place, and rotation; that of range_2 is the product for yaw, pitch, roll.
_UNMOUNTED = PREFIX + 'base_link', 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
_MOUNTS = {f'{PREFIX}imu': _UNMOUNTED, f'{PREFIX}mcu_imu': _UNMOUNTED,
           f'{PREFIX}range_1': _UNMOUNTED, f'{PREFIX}range_2': (
               PREFIX + 'base_link', *MOUNT[:3], 0.072852, -0.084306, 0.250695, 0.961633)}
_KNOWN = 200             # measurements until the bridge knows the clock; twice what it says
_LATE, _LATE_BY = 250, 0.2      # this one, and all behind it, are sent so late; s
_NEW_CLOCK = 50          # values after an opening at least until the bridge knows the clock
_WITHIN = 0.005          # s from the measurement
_SILENCE, _FRAMING = 'mcu: the board is silent', 'mcu: framing'      # in the log
_NO_FRAME = 5.0          # s in which bytes come, but no valid frame, until that is said
_RATE = 1.003e6          # ticks of the board's clock in a second
_VALID = codec.mcu_frame(0x55, 0, bytes(range(16, 32)))
_FALSE_START = b'\x02\xFF\x55'
_UNKNOWN = codec.arduino_packet(200, b'abc')
_NO_ROTATIONS = [struct.pack('>11h', round(16384 * norm), *[0] * 10) for norm in (1.06, 0.94, 0)]
# Invalid bytes, and the counter of each; each comes between valid frames.
DAMAGE = {
    'arduino': (
        ('framing errors', b'\0\0\x09\x01\x02\0'),       # behind two empty packets
        ('length errors', codec.arduino_packet(codec.TICKS, b'\1\2')),
        ('unknown type errors', _UNKNOWN),
        ('implausible errors', codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', 100.5))),
        ('implausible errors', codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', math.nan))),
        *(('implausible errors', codec.arduino_packet(codec.IMU, packet))
          for packet in _NO_ROTATIONS),
        ('implausible errors', codec.arduino_packet(BLOB, b'\1\0')),
        ('implausible errors', codec.arduino_packet(codec.STEERING_ANGLE, b'\x01\x04')),
        ('oversize errors', b'\x01' * 300 + b'\0'),
        ('oversize errors', codec.arduino_packet(BLOB, 64 * b'\1\2\3\0'))),     # 257 bytes
    'mcu': 3 * (
        ('checksum errors', bytes((*_VALID[:8], _VALID[8] ^ 1, *_VALID[9:]))),
        ('framing errors', _VALID[:-1] + b'\x04'), ('framing errors', b'\x77'),
        ('framing errors', b'\x02\0\0\x03'), ('framing errors', b'\x02\x01\x55\x55\x03'),
        ('framing errors', codec.mcu_frame(codec.SENSORS, 0, b'12345678')),
        ('length errors', codec.mcu_frame(CLIFF, 0, b'12')))}


def at_rest(rig: Rig) -> None:
    """The heartbeats of 5 s, what /diagnostics counts of them, the mounts, and the car's texts."""
    not_sent = _count_beats(rig)
    began, beats = time.monotonic(), rig.car.all_beats
    rig.wait_beats(5.0)
    seconds, beats = time.monotonic() - began, rig.car.all_beats - beats
    rig.row('heartbeats: 100 a second').check(
        abs(beats / seconds - 100) < 2, f'{beats} in {seconds:.3f} s')
    off = [before - after for before, after in zip(not_sent, _count_beats(rig))]
    rig.row(_COUNTED).check(max(map(abs, off)) < 30, f'heartbeats and frames sent: {off} off')
    rig.row('the mounts of the parameters are on /tf_static').check(
        rig.robot.mounts == _MOUNTS, f'{rig.robot.mounts}')
    for severity in range(4):
        rig.car.write(codec.arduino_packet(severity, b'text %d\0' % severity))
    found, logged = len(rig.logs.find(r'says: line \d')), rig.row('what happened is in the log')
    rig.car.write(codec.arduino_packet(1, b'odd \xff\x1b[2J\n text\0'))
    rig.car.write(b''.join(codec.arduino_packet(1, b'line %d\0' % number) for number in range(90)))
    logged.wait(lambda: len(rig.logs.find(r'says: line \d')) == found + 90,
                'all texts of the board', 10.0)
    logged.check(rig.logs.find('says: odd [^\x1b\n]* text') and not rig.logs.find('says: text 0'),
                 'a text with control characters is shown as it is, or a DEBUG text is shown')
    set_level = rospy.ServiceProxy(f'{NODE}/set_logger_level', SetLoggerLevel)
    set_level('rosout', 'debug')

    def is_shown() -> List[str]:
        rig.car.write(codec.arduino_packet(0, b'detail\0'))
        return rig.logs.find(r'\[DEBUG\].*arduino says: detail')
    logged.wait(is_shown, 'a DEBUG text')
    set_level('rosout', 'info')


def measurements(rig: Rig) -> None:
    """All types of messages of the car and the sensor board."""
    for number in range(25):
        rig.measure()
        rig.sensors.cliff()
        if number < 10:     # with the type 247 … 256 bytes
            size = 246 + number
            rig.car.send(codec.arduino_packet(BLOB, bytes(1 + n % 255 for n in range(size))))
        text = b'%d \xc2\xb0C' % number + b'\0old' * (number % 2)
        rig.car.send(codec.arduino_packet(NOTE, b'\1' + text))
        rig.wait_beats(0.05)
    for limit in (codec.arduino_packet(codec.STEERING_ANGLE, b'\x00\x04'),
                  codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', 100.0))):
        rig.car.send(limit)
    # Its heading alone is no sign of an unknown attitude, and its ranges are the limits.
    rig.sensors.send(rig.sensors.status(2000, 30, 0x8000, 5, 6))
    rig.compare(rig.car, rig.sensors)


def alone(rig: Rig) -> None:
    """Topics of one packet, each as the only one with a subscriber."""
    for topic in rig.tries('~imu', '~imu/temperature', 'mcu/range_2', 'tf/imu_orientation',
                           'tf/place'):
        with rig.robot.only(topic):
            rig.sleep(0.5)      # until the bridge knows that the other subscribers have gone
            rig.wait_for_data(topic, rig.measure, rig.row(PUBLISHED), UNTIL_PUBLISHED)
        rig.wait(lambda: rig.robot.connected, 'all are subscribed again')


def _count_beats(rig: Rig) -> List[int]:
    """How many more heartbeats were received than /diagnostics counts as heartbeats and as frames
    that were sent. At rest no other frames are."""
    values = rig.next_report('arduino')[2]
    return [rig.car.all_beats - int(values[key]) for key in ('heartbeats sent', 'frames sent')]


def damaged(rig: Rig) -> None:
    """Invalid frames, each between valid ones; noise before a frame; a false start, and then a byte
    each 30 ms between frames."""
    required = rig.row('every error is counted by cause and costs no valid frame')
    before = unknown_types(rig)        # in the first 5 s of a connection they do not count
    rig.wait(lambda: unknown_types(rig) > before or not rig.car_line.write(_UNKNOWN), 'one counts')
    for link, board in rig.tries(('arduino', rig.car), ('mcu', rig.sensors)):
        keys = [key for key, _data in DAMAGE[link]]
        with rig.counted(required, link, {key: keys.count(key) for key in keys}) as began:
            for _key, data in DAMAGE[link]:
                board.measure()
                # A length error of the sensor board has the SEQ of the frame before it.
                board.line.write(data if data[:1] != b'\x02' else codec.mcu_frame(
                    CLIFF, rig.sensors.seq, b'12') if data[2] == CLIFF else data)
                board.measure()
            rig.diagnosed(link, 1, 'errors in the last second', began)
            rig.compare(board)
    with rig.counted(required, 'mcu', {'framing errors': 2}):       # each has at most 1100 bytes
        rig.mcu_line.write(b'\x77' * 1500)
        rig.sensors.measure()
    causes = {(link, key.split()[0]) for link in DAMAGE for key, _data in DAMAGE[link]}
    rig.row('what happened is in the log').wait(
        lambda: causes <= set(rig.logs.find(r'(arduino|mcu): (\w+)')), 'each cause is logged', 10.0)
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
    with rig.clock.each(0.1, lambda: rig.car_line.write(b'the temperature is 21.5 C\r\n\0')):
        rig.diagnosed('arduino', 1, 'the sketch prints text')


def unknown_types(rig: Rig) -> int:
    return int(rig.next_report('arduino')[2]['unknown type errors'])


def lost_frames(rig: Rig) -> None:
    """Gaps in SEQ, and doubled frames."""
    rig.sensors.cliff()
    rig.wait(lambda: rig.robot.published['mcu/cliff'], 'the first frame')
    gaps = 0, 1, 0, 5, 200, 0, 254
    with rig.counted(rig.row('every lost and every doubled frame is counted'), 'mcu',
                     {'frames lost': sum(gaps), 'frames doubled': 12}):
        for gap in gaps:
            rig.sensors.seq = (rig.sensors.seq + gap) % 256
            rig.sensors.cliff()
            rig.sensors.write(rig.sensors.frame(CLIFF, b'\xff' * 4))       # implausible
        for _ in range(4):
            rig.sensors.write(2 * rig.sensors.frame(0x55, b'of an unknown type'))
            rig.sensors.cliff()
            rig.sensors.line.write(2 * rig.sensors.written[-1])     # the same again, twice
        rig.compare(rig.sensors)


def false_starts(rig: Rig) -> None:
    """A frame after a false start is published when that times out, with an earlier stamp."""
    required = rig.row('a frame after a false start keeps the stamp of its read')
    ahead = time.time() - time.monotonic()
    for start in rig.tries(b'\x02', b'\x02\x60', b'\x02\x60\x55'):
        rig.sensors.line.write(start)
        rig.sensors.measure()
        status = required.wait(lambda: rig.robot.values('mcu/status'), 'the status')[0]
        least = _FRAME_TIMEOUT - 0.005 if len(start) > 1 else 0.0
        rig.in_time(required, status.stamp - ahead, status.wall - ahead, _GIVEN_UP,
                    'from its stamp to its arrival', least)


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
    rig.end(rig.user('subscriber', 'another', '/serial_msg'))      # this one goes on
    rig.settle()
    wanted = {'frames received': 40, 'framing errors': 20, 'checksum errors': 0,
              'bytes received': 0}
    sent = {'frames sent': 0, 'bytes sent': 0}
    began = time.time() - 0.1
    with rig.counted(counters, 'mcu', wanted), rig.counted(counters, 'bus', sent):
        rig.clear_records()
        for number in range(1, 21):
            rig.measure()
            rig.sensors.write(codec.mcu_frame(0x55, number, b'damaged')[:-1] + b'!')
            drive.command('steering')
            rig.robot.call('bus/echo')
        rig.car.send(codec.arduino_packet(BLOB, bytes(1 + n % 255 for n in range(255))))
        rig.sleep(0.1)      # a damaged frame is given up
        wanted['bytes received'] = len(b''.join(rig.sensors.written))
        requests = [codec.bus_frame(bytes((each.cmd1, each.cmd2)), each.data)
                    for each in rig.bus.requests]
        sent.update({'frames sent': len(requests), 'bytes sent': len(b''.join(requests))})
    for link, direction, frames, frame_at in (
            ('arduino', 1, [codec.arduino_packet(each.type, each.data) for each in rig.car.packets],
             codec.arduino_at),
            ('bus', 1, requests, codec.request_at),
            *((board.line.name, 0, board.written, board.sent_frame_at)
              for board in (rig.car, rig.sensors, rig.bus))):
        frames = [frame for frame in frames         # signs of life are all the same
                  if b'damaged' not in frame and frame != codec.arduino_packet(ALIVE)]

        def found() -> List[SerialMsg]:
            return [each for each in list(shown[link, direction]) if bytes(each.frame) in frames]
        rig.until_published(lambda: len(found()) >= len(frames))
        for each, frame in itertools.zip_longest(found(), frames):
            content = codec.decode(frame or b'', frame_at)[0]
            if required.check(
                    each and content and bytes(each.frame) == frame and content[0].content
                    == (each.type, each.command, bytes(each.data)) and each.text
                    and not each.error, f'{link} {direction}: {each}, not {frame!r}'):
                required.check(_is_described(each, began), f'{link} {direction}: {each}')
    rig.robot.call('probe')
    required.wait(lambda: 'probe OK' in [each.text for each in shown['bus', 0]],
                  'the name of a function beside its reply', UNTIL_PUBLISHED)
    errors = b''.join(bytes(each.frame) for each in shown['mcu', 0] if each.error)
    required.check(errors.count(b'damaged') == 20, 'not all damaged frames are shown')
    subscriber.unregister()
    rig.settle()
    with rig.counted(counters, 'bus', {'frames sent': 1}):      # also if nobody subscribes
        rig.robot.call('bus/echo')
    for link, line in rig.lines.items():
        counters.check(rig.next_report(link)[2]['hardware id'] == line.port, f'port of {link}')


def _is_described(shown: SerialMsg, began: float) -> bool:
    """Whether the header and the text of a frame are right, for a time that began then."""
    is_counter = (shown.link, shown.type) == ('arduino', COUNTER)
    return began < shown.header.stamp.to_sec() < time.time() and (
        not is_counter
        or shown.text == f'counter data={int.from_bytes(shown.data, "little")}')


def opened(port: str) -> IO[bytes]:
    return open(port, 'rb', buffering=0, opener=lambda path, flags: os.open(
        path, flags | os.O_NOCTTY | os.O_NONBLOCK))


def settings(rig: Rig) -> None:
    """Another program changes the settings of the port (stty icrnl)."""
    required = rig.row('changed settings of a tty are restored within 0.3 s')
    for _ in rig.tries(*range(3)):
        with opened(rig.car_line.port) as port:
            changed = termios.tcgetattr(port)
            changed[0] |= termios.ICRNL
            changed[3] |= termios.ECHO
            termios.tcsetattr(port, termios.TCSANOW, changed)
        rig.sleep(0.3)
        required.check(any(each.is_stop for each in rig.car.packets), 'no SPEED 0 afterwards')
        rig.clear_records()
        for _ in range(20):
            rig.car.send(codec.arduino_packet(codec.TICKS, b'\x0d'))
            rig.wait_beats(0.02)
        rig.compare(rig.car)
        echoed = [each for each in rig.car.packets if not each.is_stop]
        required.check(not echoed, f'{echoed[:3]} was echoed to the board')
    with opened(rig.car_line.port) as port:
        changed = termios.tcgetattr(port)
        changed[4:6] = 2 * [termios.B9600]
        termios.tcsetattr(port, termios.TCSANOW, changed)
        rig.sleep(0.3)
        required.check(termios.tcgetattr(port)[4:6] == 2 * [termios.B115200], '9600 baud stays')
    rig.settle()
    with opened(rig.bus_line.port) as port:
        changed = termios.tcgetattr(port)
        changed[0] |= termios.ICRNL
        termios.tcsetattr(port, termios.TCSANOW, changed)
    rig.sleep(0.3)
    required.check([each.cmd1 for each in rig.bus.requests] == [codec.ECHO],
                   f'the bus board received {rig.bus.requests}')


def silent(rig: Rig) -> None:
    """The boards send, and fall silent."""
    reported, logged = rig.row(REPORTED), rig.row('what happened is in the log')
    rig.car.talks = False
    logged.wait(lambda: rig.logs.find(_SILENCE), 'the silence at rest', 15.0)
    _go_on(rig)             # for so long that the next silence is logged, too
    silences = len(rig.logs.find(_SILENCE))
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
    logged.wait(lambda: len(rig.logs.find(_SILENCE)) > silences, 'a silence is logged', 15.0)
    count = len(statuses)
    with rig.clock.each(0.05, rig.sensors.cliff):
        reported.wait(lambda: len(statuses) > count + 2, 'reports while other frames come', 10.0)
    rig.mcu_line.write(b'\x77')
    for _ in range(2):          # this error is counted while it is silent
        level, text, _values = rig.next_report('mcu')
    with rig.clock.each(0.05, rig.measure):
        while 'silent' in text:
            level, text, _values = rig.next_report('mcu')
    rig.row('level and words in /diagnostics are true').check(
        level == 0, f'{text}, of an error from the silence')
    logged.wait(lambda: rig.logs.find('mcu: the board is back'), 'its return', 10.0)
    rig.car.talks = True


def _go_on(rig: Rig) -> None:
    """One error each second, for over 10 s: a line each 10 s."""
    count = len(rig.logs.find(_FRAMING))
    with rig.clock.each(1.0, lambda: rig.mcu_line.write(b'\x77')):
        rig.row('what happened is in the log').wait(
            lambda: len(rig.logs.find(_FRAMING)) > count + 1, 'it is logged again', 25.0)


class Timing(NamedTuple):
    """How a board sends values, and when they were measured."""

    topic: str           # where they are published; ~timed: each has the time itself
    batch: float         # s; the bytes are sent at each multiple of it; 0.0: at once
    origin: int          # the board's clock at the beginning, in µs
    each: int = 1        # values behind one TIME
    damaged: int = _TIMES     # one of so many TIMEs is for no value
    reopened: int = _TIMES    # the port is opened anew before this value

    def has_time(self, number: int) -> bool:
        """Whether the time of this value was sent."""
        return self.topic == '~timed' or bool(number // self.each % self.damaged)

    def send(self, rig: Rig, board_time: int, number: int) -> None:
        """Send the values from this number on that are measured together."""
        at, value = struct.pack('<I', board_time), bytes((number % 256,))
        if self.topic == 'mcu/adc_status':
            if number == _LATE + 1:
                rig.sensors.seq = 254       # so that the value has 0
            frame = rig.sensors.frame(codec.TIME, at)
            rig.sensors.seq += not self.has_time(number)     # TIME is for the next SEQ
            rig.sensors.line.write(frame + rig.sensors.frame(codec.ADC, value + bytes(11)))
        elif self.topic == '~timed':
            rig.car.line.write(codec.arduino_packet(TIMED, at + value))
        else:       # without its count TIME is too short
            count = bytes((self.each,)) if self.has_time(number) else b''
            first, *others = [codec.arduino_packet(codec.TICKS, bytes(((number + behind) % 256,)))
                              for behind in range(self.each)]
            rig.car.line.write(codec.arduino_packet(codec.TIME, at + count) + first)
            if others:      # what TIME does not count
                rig.car.line.write(codec.arduino_packet(codec.SETTING, b'\x01\0')
                                   + codec.arduino_packet(
                                       codec.ANNOUNCEMENT, codec.announcement(b'half', 2)[0]))
            for packet in others:
                time.sleep(0.003)       # so that the bridge reads it later
                rig.car.line.write(packet)


def _send_with_time(rig: Rig, timing: Timing) -> List[float]:
    """Send values, late after 2.5 s. Return when each was measured, by time.time()."""
    measured: List[float] = []
    began, ahead = time.monotonic(), time.time() - time.monotonic()
    for number in range(0, _TIMES, timing.each):
        at, batch = began + number * _EACH, timing.batch
        time.sleep(max(0.0, (math.ceil(at / batch) * batch if batch else at) - time.monotonic()))
        at = at if batch else time.monotonic()
        if number == _LATE:
            time.sleep(_LATE_BY)
        if number == timing.reopened:
            # What the line still has would be lost with it.
            rig.until_published(lambda: len(rig.robot.published[timing.topic]) >= timing.reopened)
            rig.car_line.unplug()
            rig.car_line.plug()
            rig.wait(lambda: rig.car.beats > 5, 'heartbeats')
            at = time.monotonic()
        timing.send(rig, round(timing.origin + (at - began) * _RATE) % 2 ** 32, number)
        measured += timing.each * [at + ahead]
    return measured


def stamps(rig: Rig) -> None:
    """The board's clock wraps, and the port is opened anew."""
    _try_stamps(rig, Timing('~ticks', 0.0, 2 ** 32 - 2_500_000, reopened=110))


def stamps_of_batches(rig: Rig) -> None:
    """Two values have one time; some times are damaged."""
    _try_stamps(rig, Timing('~ticks', 0.016, 0, each=2, damaged=7))


def stamps_after_a_stall(rig: Rig) -> None:
    """A custom message has the time itself."""
    with rig.suspended():
        rig.sleep(0.5)
    rig.sleep(1.0)              # until nothing is dropped any more
    _try_stamps(rig, Timing('~timed', 0.016, 2 ** 31))


def stamps_of_sensors(rig: Rig) -> None:
    """SEQ tells whether a value belongs to the time before it; some times are missing."""
    _try_stamps(rig, Timing('mcu/adc_status', 0.016, 0, damaged=7))


def _try_stamps(rig: Rig, timing: Timing) -> None:
    """The board's clock drifts, and from one value on it and all others are late."""
    never = rig.row('a stamp is never after the read')
    within = rig.row("with the board's time a stamp is within 5 ms of the measurement")
    types = {('arduino', codec.TICKS), ('arduino', TIMED), ('mcu', codec.ADC)}
    reads: List[float] = []
    subscriber = rig.robot.subscribe_to_traffic(
        lambda frame: reads.append(frame.header.stamp.to_sec())
        if frame.direction == 0 and (frame.link, frame.type) in types else None)
    rig.wait(lambda: rig.car.measure() or rig.wait_beats(0.02) or reads, 'serial_msg')
    rig.settle()
    published = rig.robot.published[timing.topic]
    reads.clear()
    rig.car.talks = False       # else this may come between a time and its values
    measured = _send_with_time(rig, timing)
    rig.car.talks = True
    rig.until_published(lambda: min(len(published), len(reads)) >= _TIMES)
    stamp, ahead = 0.0, time.time() - time.monotonic()
    for number, (at, one, read) in enumerate(itertools.zip_longest(measured, published, reads)):
        value = one and (one.key[1] if isinstance(one.key, tuple) else one.key)
        if not never.check(at and read and value == number % 256, f'{timing.topic} {number} of '
                           f'{len(published)} and {len(reads)} is not published'):
            break
        text = f'{timing.topic} {number}: measured {at:.4f}, read {read:.4f}, stamped ' \
               f'{one.stamp:.4f}'
        never.check(one.stamp <= read + 1e-6, text)
        if number == _LATE:
            never.check(read - at >= _LATE_BY, f'{text}: serial_msg has no time of the read')
        if not timing.has_time(number) or 0 <= number - timing.reopened < _NEW_CLOCK:
            never.check(one.stamp == read, text)
        elif number >= _KNOWN:
            off = abs(one.stamp - at)
            if off > _WITHIN and rig.machine.held(measured[0] - ahead, at - ahead) >= LATE:
                within.undecided += 1
            else:
                within.at_most(off * 1e3, _WITHIN * 1e3, 'ms', text)
            within.check(not number % timing.each or one.stamp == stamp,
                         f'{text}, the one measured with it {stamp:.4f}')
        stamp = one.stamp
    subscriber.unregister()


# The measurements are short, four times, and so are the stamps: on a busy machine a long scenario
# is stalled too often.
def hints(rig: Rig) -> None:
    """Boards at the wrong ports, messages without a row, a sensor without values, and a car that
    logs too much."""
    logged = rig.row('what happened is in the log')

    def status(range_1: int) -> bytes:
        return rig.sensors.status(range_1, 99, 1, 1, 1)

    def swap() -> None:
        rig.mcu_line.write(codec.arduino_packet(codec.TICKS, b'\1'))
        rig.car_line.write(status(99))
    rig.car.talks = False
    with rig.clock.each(0.02, swap):
        rig.sleep(_NO_FRAME)
        for link in 'mcu', 'arduino':
            rig.diagnosed(link, 1, 'no valid frame: wrong baud rate or board?')
    rig.car.measure()       # the bytes before it count no more
    with rig.clock.each(0.02, lambda: rig.car_line.write(_UNKNOWN)):
        rig.sleep(_NO_FRAME)
        rig.diagnosed('arduino', 1, 'of unknown types')
    rig.car.talks = True
    with rig.clock.each(0.05, lambda: rig.sensors.write(status(0xFFFF))):
        logged.wait(lambda: rig.logs.find('mcu: no value of range 1'), 'a sensor times out', 10.0)
    with rig.clock.each(0.05, lambda: rig.sensors.write(status(99))):
        logged.wait(lambda: rig.logs.find('mcu: all sensors have values'), 'it is back', 10.0)
    rig.car.write(300 * codec.arduino_packet(1, b'loud\0'))
    logged.wait(lambda: rig.logs.find('arduino: the board logs too much'), 'too many lines', 10.0)


SERIAL = (at_rest, *4 * (measurements,), alone, damaged, lost_frames, false_starts, traffic,
          settings, silent, silent, hints)
LONG = stamps, stamps_of_batches, stamps_after_a_stall, stamps_of_sensors
