"""The model car, exactly: what reached it against what was commanded.

Every command carries a number of its own. Times on the line are counted in heartbeats: however late
this process reads them, their number between two packets is what it was. Where something must not
come, a later command, or heartbeats, are waited for, which come after it on the same line.
"""
import contextlib
import signal
import struct
import time
from typing import Any, List, Tuple

import by_definition as codec
from processes import StageError
from .boards import BEAT, WINCH, Packet
from .field import BACK, FIRST, LATCHED, RETURN, SPEED_TIMEOUT, UNTIL_PUBLISHED, Field

TYPES = {'speed': codec.SPEED, 'steering': codec.STEERING, 'winch': WINCH}
COUNTED = 'every error is counted by its cause and costs no valid frame'
_LATE_ZERO = 0.05        # s that SPEED 0 may come later than speed_timeout
_REPEAT_PERIOD = 0.05    # s
_REPEATED = 1.0          # s
_AGE = 0.8               # s, over arduino/command_age
_AFTER = 60              # heartbeats in which nothing may come
_STOPPED = 1.2           # s of SIGSTOP


class Drive:
    """Commands with numbers of their own; one after the other."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.arrives = field.row('commands', 'a command reaches an open port at once, and once')
        self.nothing_old = field.row('motor', 'nothing old drives the motor: not sent, not kept')
        self._number = 0

    def next(self) -> int:
        """A value that was not commanded in this scenario."""
        self._number += 1
        return self._number

    def command(self, name: str = 'speed', value: int = 0) -> Packet:
        """Publish it, or the next number; the packet that came of it."""
        value, since = value or self.next(), len(self.field.car.packets)
        self.field.robot.command(name, value)
        return self.arrives.wait(lambda: self.field.car.packet(TYPES[name], value, since),
                                 f'{name} {value} arrives')

    def in_vain(self, times: int, *names: str) -> List[int]:
        """Publish numbers of which none is to arrive, 50 ms apart; they are returned."""
        values = [self.next() for _ in range(times)]
        for value in values:
            for name in names:
                self.field.robot.command(name, value)
            self.field.let_pass(0.05)
        return values

    def again(self) -> Packet:
        """Command new speeds until one is taken: the bridge takes commands again."""
        field, since = self.field, len(self.field.car.packets)
        first = self._number + 1

        def taken() -> Any:
            field.robot.command('speed', self.next())
            field.beats(3)
            return next((packet for packet in field.car.packets[since:]
                         if packet.type == codec.SPEED and packet.number >= first), None)
        return self.arrives.wait(taken, 'a command is taken again')

    def none_of(self, values: List[int], name: str, what: str, since: int = 0) -> None:
        came = set(self.field.car.commands(TYPES[name], since))
        for value in values:
            self.nothing_old.check(value not in came, f'{name} {value}, {what}, reached the board')


def measurements(field: Field) -> None:
    """Every kind of message of both boards that talk, a hundred of each."""
    field.calm()
    with field.heartbeats():
        for _ in range(50):
            for _ in range(2):
                field.car.measure()
                field.sensors.measure()
                field.sensors.cliff()
            field.beats(2)
    field.compare(field.car, field.sensors)


def traffic(field: Field) -> None:
    """What a subscriber of serial_msg is shown, against what passed on the lines."""
    row = field.row('data', 'serial_msg has every frame, in and out, once and in order')
    drive = Drive(field)
    boards = {'arduino': field.car, 'mcu': field.sensors, 'bus': field.bus}
    with field.traffic() as shown:
        field.calm()
        for _ in range(20):
            field.car.measure()
            field.sensors.measure()
            drive.command('steering')
            field.robot.call('bus/echo')
        came = [codec.arduino_packet(one.type, one.data) for one in field.car.packets]

        def of_now(way: Tuple[str, int], frames: List[bytes]) -> List[bytes]:
            return [frame for frame in list(shown[way]) if frame in frames]

        for way, frames in ((('arduino', 1), came), *(
                ((link, 0), board.said) for link, board in boards.items())):
            with contextlib.suppress(StageError):
                field.wait(lambda: len(of_now(way, frames)) >= len(frames), '', UNTIL_PUBLISHED)
            row.check(of_now(way, frames) == frames, f'{way}: {len(frames)} frames passed, '
                      f'{len(of_now(way, frames))} of them were shown')


def commands(field: Field) -> None:
    """Each kind of command, SPEED beyond its limits included."""
    row = field.row('commands', 'each arrives as it was given; SPEED saturated; no LED too long')
    drive = Drive(field)
    field.calm()
    for name, values in (('speed', (1, -2, 999, 1000, -1000)), ('steering', range(1500, 1530)),
                         ('winch', range(40000, 40010))):
        for value in values:
            drive.command(name, value)
        came = [value for value in field.car.commands(TYPES[name]) if value or name != 'speed']
        row.check(came == list(values), f'{name}: {list(values)} were given, {came} arrived')
    for given, taken in ((5000, 1000), (-32768, -1000)):
        since = len(field.car.packets)
        field.robot.command('speed', given)
        row.wait(lambda: field.car.packet(codec.SPEED, taken, since), f'SPEED {given} as {taken}')
    for text in ('left', 'x' * 31, 'x' * 30, 'ma\u00f1ana', 'disable'):
        field.robot.command('led', text)
    row.wait(lambda: b'disable\0' in [one.data for one in field.car.packets], 'LED disable arrives')
    lights = [one.data for one in field.car.packets if one.type == codec.LED]
    row.check(lights == [b'left\0', b'x' * 30 + b'\0', b'disable\0'], f'LED: {lights} arrived')


def stops(field: Field) -> None:
    """A speed with nothing behind it; a SPEED 0; a speed while SPEED 0 is repeated."""
    in_time = field.row('motor', 'SPEED 0 within speed_timeout + 50 ms of the last command')
    early = field.row('motor', 'SPEED 0 commanded, or due by a rule, and never else')
    drive = Drive(field)

    def left_alone() -> Packet:
        commanded = time.monotonic()
        packet = drive.command()
        zero = in_time.wait(lambda: field.car.zero_after(packet), 'SPEED 0')
        in_time.at_most((zero.since(packet) - BEAT) * 1e3, (SPEED_TIMEOUT + _LATE_ZERO) * 1e3, 'ms',
                        'by heartbeats')
        early.check(zero.t - commanded > SPEED_TIMEOUT - 0.005,
                    f'SPEED 0 {zero.t - commanded:.3f} s after the command')
        return zero

    for _ in range(2):
        field.calm()
        _repeated(field, left_alone())
    field.calm()
    packet = drive.command()
    field.robot.command('speed', 0)
    _repeated(field, in_time.wait(lambda: field.car.zero_after(packet), 'SPEED 0'))
    drive.command()
    field.robot.command('speed', 0)
    in_time.wait(lambda: field.car.commands(codec.SPEED)[-3:] == [0, 0, 0], 'SPEED 0 is repeated')
    left_alone()        # ends the repetitions


def _repeated(field: Field, zero: Packet) -> None:
    row = field.row('motor', 'every SPEED 0 that ends a motion is repeated: 50 ms apart, for 1 s')
    field.wait(lambda: field.car.beat - field.car.packets[-1].beat > 20, 'the stop is over')
    zeros = field.car.packets[field.car.packets.index(zero):]
    row.check(all(one.stops for one in zeros), f'another packet among {zeros}')
    for before, after in zip(zeros, zeros[1:]):
        row.at_most((after.since(before) - BEAT) * 1e3, _REPEAT_PERIOD * 1e3 + 10, 'ms',
                    'from one SPEED 0 to the next, by heartbeats')
    # The first may have been read late, and a bridge that may not come first beats less often.
    lasted = max(zeros[-1].since(zero), zeros[-1].t - zero.t)
    row.check(lasted >= _REPEATED - 2 * _REPEAT_PERIOD, f'for {lasted:.3f} s only')
    row.check(zeros[-1].since(zero) <= _REPEATED + 2 * _REPEAT_PERIOD,
              f'for {zeros[-1].since(zero):.2f} s, by heartbeats')


def openings(field: Field) -> None:
    """Unplugged while it stands and while it drives, back under the same and under another name."""
    first, back = field.row(*FIRST), field.row(*BACK)
    drive = Drive(field)
    for index in range(4):
        field.calm()
        old = [drive.command().number] if index % 2 else []
        field.car_line.unplug()
        old += drive.in_vain(5, 'speed')
        since, began = len(field.car.packets), time.monotonic()
        field.car_line.plug(another_name=index > 1)
        field.wait(lambda: field.car.beat, 'heartbeats')
        back.at_most(field.car.beats[0] - began, RETURN, 's', 'arduino')
        field.beats(_AFTER)
        one = field.car.first[field.car.connection]
        first.check(one.stops, f'{one} was the first')
        drive.none_of(old, 'speed', 'commanded before the reconnect', since)
        drive.command()


def old_stamps(field: Field) -> None:
    """Stamps of before, and of a time to come."""
    row = field.row('old commands', 'a stamp over 0.5 s old, or ahead, is refused; SPEED 0 never')
    drive = Drive(field)
    field.calm()
    for name in ('speed', 'steering'):
        for age in (_AGE, 3600.0, -_AGE, -3600.0):
            bad = drive.next()
            field.robot.command(name, bad, time.time() - age)
            drive.command(name)         # on the same connection
            row.check(field.car.packet(TYPES[name], bad) is None,
                      f'{name}, its stamp {age:g} s old, arrived')
        value = drive.next()
        field.robot.command(name, value, time.time())
        row.wait(lambda: field.car.packet(TYPES[name], value), f'{name} with a stamp of now')
    for age in (3600.0, -3600.0):
        packet = drive.command()
        field.robot.command('speed', 0, time.time() - age)
        zero = row.wait(lambda: field.car.zero_after(packet), 'SPEED 0')
        row.check(zero.since(packet) < SPEED_TIMEOUT - 0.05,
                  f'SPEED 0, its stamp {age:g} s old, was refused')


def latched(field: Field) -> None:
    """A publisher that latches appears, and appears again under its name."""
    row = field.row(*LATCHED)
    field.calm()
    for first, second, taken in ((101, 102, True), (201, 202, False)):
        child = field.user('latch', 'latcher', first, second)
        row.wait(lambda: 'connected' in child.tail()[-12:], 'the bridge connects')
        child.order('next')     # on the same connection, behind the latched one
        row.wait(lambda: field.car.packet(codec.SPEED, second), 'the next one arrives')
        times = field.car.commands(codec.SPEED).count(first)
        row.check(times == taken, f'latched by a publisher {"new" if taken else "heard before"}: '
                                  f'arrived {times} times')
        field.end(child)


def old_connection(field: Field) -> None:
    """Two publishers of one name: the older one stands still, and wakes."""
    row = field.row('old commands', 'of one name only the newest connection is listened to')
    field.calm()
    older = field.user('driver', 'twin', 100)
    row.wait(lambda: field.car.commands(codec.SPEED), 'the first one drives')
    older.hold()
    newer = field.user('driver', 'twin', 500)
    row.wait(lambda: max(field.car.commands(codec.SPEED)) >= 500, 'the second one does')
    since = len(field.car.packets)
    field.beats(10)
    older.send(signal.SIGCONT)
    field.beats(_AFTER)
    came = [value for value in field.car.commands(codec.SPEED, since) if 0 < value < 500]
    row.check(not came, f'{came} came on the old connection')
    for child in (newer, older):
        field.end(child)


def frozen(field: Field) -> None:
    """The board reads nothing, and the line is full; commands go on."""
    first = field.row('motor', 'dropped output counts as motion: SPEED 0 is the first thing after')
    drive = Drive(field)
    for _ in range(2):
        field.calm()
        drive.command()
        with field.held():
            field.car_line.freeze()
        since, beat, old = len(field.car.packets), field.car.beat, []
        for index in range(20):     # what was written into the room of a drop is dropped, too
            old += drive.in_vain(index < 12, 'speed')
            field.let_pass(0.05)
            field.car_line.fill()
        field.car_line.thaw()
        field.beats(_AFTER)
        _stop_is_first(field, first, since, beat)
        drive.none_of(old, 'speed', 'commanded while the line was frozen', since)
        drive.again()


def _stop_is_first(field: Field, row: Any, since: int, beat: int) -> None:
    """Of all packets, heartbeats included, that came since there were so many."""
    packets = field.car.packets[since:]
    row.check(packets and packets[0].stops and packets[0].beat == beat,
              f'{packets[:2]} came first, {packets[0].beat - beat if packets else 0} heartbeats '
              'before them')


def stopped_bridge(field: Field) -> None:
    """SIGSTOP of the bridge; commands and data come meanwhile."""
    first = field.row('motor', 'after a stall of over 0.5 s SPEED 0 is the first packet')
    stale = field.row('data', 'what waited during a stall is dropped, and counted as stale')
    back = field.row('data', 'data again after a stall, by heartbeats')
    drive, names = Drive(field), ('speed', 'steering', 'winch')
    for _ in range(2):
        field.calm()
        car, mcu = {'stale': 0}, {'stale': 0}
        with field.counts(stale, 'arduino', car), field.counts(stale, 'mcu', mcu):
            drive.command()
            old: List[int] = []
            with field.held():
                since, beat = len(field.car.packets), field.car.beat
                for _ in range(6):
                    old += drive.in_vain(1, *names)
                    field.car.measure()
                    field.sensors.measure()
                    field.let_pass(_STOPPED / 6 - 0.05)
            field.beats(_AFTER)
            car['stale'] = len(b''.join(field.car.said))
            mcu['stale'] = len(b''.join(field.sensors.said))
        _stop_is_first(field, first, since, beat)
        for name in names:
            drive.none_of(old, name, 'commanded while the bridge was stopped', since)
        for topic in {one.topic for one in field.car.sent + field.sensors.sent}:
            came = [one.key for one in field.robot.got[topic] if one.key is not None]
            stale.check(not came, f'{topic}: {came[:3]} were published')
        beat = field.car.beat
        field.flows('~counter', field.car.measure, back)
        back.note((field.car.beat - beat) * BEAT, 's')
        drive.again()


def calibration(field: Field) -> None:
    """While the board calibrates it reads nothing: it is told nothing."""
    row = field.row('motor', 'nothing for a board that calibrates; SPEED 0 before the request')
    over = field.row('commands', 'a calibration is over with IMU data after a silence, not before')
    drive = Drive(field)
    for moves in (True, False):
        field.calm()
        if moves:
            drive.command()
        field.robot.call('calibrate_imu')
        request = row.wait(lambda: [one for one in field.car.packets
                                    if one.type == codec.CALIBRATION], 'the request')[0]
        at = field.car.packets.index(request)
        row.check(not moves or field.car.packets[at - 1].stops,
                  f'{field.car.packets[at - 1:at]} came before it')
        field.car.measure()         # was under way as the calibration began
        drive.in_vain(46, *TYPES)
        field.beats(10)
        row.check(len(field.car.packets) == at + 1,
                  f'{field.car.packets[at + 1:at + 3]} came while it calibrated')
        field.car.measure()
        over.check(drive.again(), '')


def damaged(field: Field) -> None:
    """Packets that are none, each among good ones."""
    row = field.row('data', COUNTED)
    bad = (
        ('framing errors', b'\x09\x01\x02\x00'),
        ('length errors', codec.arduino_packet(codec.TICKS, b'\1\2')),
        ('unknown type errors', codec.arduino_packet(200, b'abc')),
        ('implausible errors', codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', 300.0))),
        ('implausible errors', codec.arduino_packet(codec.IMU, bytes(22))),
        ('implausible errors', codec.arduino_packet(codec.STEERING_ANGLE, b'\xFF\xFF')),
        ('oversize errors', b'\x01' * 300 + b'\0'))
    field.calm()
    keys = [key for key, _packet in bad]
    with field.counts(row, 'arduino', {key: keys.count(key) for key in keys}):
        for _key, packet in bad:
            field.car.measure()
            field.car_line.write(packet)
            field.car.measure()
        field.compare(field.car)


SCENARIOS = (measurements, traffic, commands, stops, openings, old_stamps, latched, old_connection,
             frozen, stopped_bridge, calibration, damaged)
