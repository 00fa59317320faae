"""The model car, exactly: compares the packets that it received with what was commanded.

Every command has a unique number. Times are counted in heartbeats, which late reads do not change.
To see that a packet does not arrive, a scenario waits for later packets on the same line.
"""
import contextlib
import signal
import struct
import time
from typing import Any, List, Tuple

import by_definition as codec
from processes import StageError
from .boards import PERIOD, WINCH, Packet
from .requirements import Requirement
from .rig import (ERRORS_COUNTED, LATCHED, PORT_RETURN, PORT_RETURNS, SPEED_TIMEOUT, STOP_FIRST,
                  UNTIL_PUBLISHED, Rig)

TYPES = {'speed': codec.SPEED, 'steering': codec.STEERING, 'winch': WINCH}
_STOP_DELAY = 0.05       # s that SPEED 0 may be sent later than speed_timeout
_REPEAT_PERIOD = 0.05    # s
_REPEAT_TIME = 1.0       # s
_AGE = 0.8               # s, over arduino/command_age
_HEARTBEATS_AFTER = 60   # heartbeats until a packet that must not arrive would have arrived
_STALL = 1.2             # s of SIGSTOP


class Drive:
    """Publishes commands with unique numbers."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.arrives = rig.require('commands', 'every command reaches the board of an open port')
        self.no_old = rig.require('motor', 'no command from before a reconnect, stall or restart')
        self._number = 0

    def next_number(self) -> int:
        self._number += 1
        return self._number

    def command(self, name: str = 'speed', value: int = 0) -> Packet:
        """Publish this value, or else the next number; return its packet once it arrives."""
        value, since = value or self.next_number(), len(self.rig.car.packets)
        self.rig.robot.command(name, value)
        return self.arrives.wait(lambda: self.rig.car.packet(TYPES[name], value, since),
                                 f'{name} {value} arrives')

    def publish(self, times: int, *names: str) -> List[int]:
        """Publish the next numbers, 50 ms apart, without waiting for them; return them."""
        values = [self.next_number() for _ in range(times)]
        for value in values:
            for name in names:
                self.rig.robot.command(name, value)
            self.rig.sleep(0.05)
        return values

    def command_until_accepted(self) -> Packet:
        """Publish new speeds until the bridge sends one of them."""
        rig, since = self.rig, len(self.rig.car.packets)
        first = self._number + 1

        def accepted() -> Any:
            rig.robot.command('speed', self.next_number())
            rig.wait_heartbeats(3)
            return next((packet for packet in rig.car.packets[since:]
                         if packet.type == codec.SPEED and packet.number >= first), None)
        return self.arrives.wait(accepted, 'a command arrives again')

    def check_not_sent(self, values: List[int], name: str, what: str, since: int = 0) -> None:
        sent = set(self.rig.car.commands(TYPES[name], since))
        for value in values:
            self.no_old.check(value not in sent, f'{name} {value}, {what}, reached the board')


def measurements(rig: Rig) -> None:
    """All types of messages of the car and the sensor board, a hundred of each."""
    rig.settle()
    with rig.no_missed_heartbeat():
        for _ in range(100):
            rig.car.measure()
            rig.sensors.measure()
            rig.sensors.cliff()
            rig.wait_heartbeats(1)
    rig.compare(rig.car, rig.sensors)


def traffic(rig: Rig) -> None:
    """What serial_msg shows, compared with the frames on the lines."""
    required = rig.require('data', 'serial_msg has every received and sent frame once, in order')
    drive = Drive(rig)
    boards = {'arduino': rig.car, 'mcu': rig.sensors, 'bus': rig.bus}
    with rig.traffic() as shown:
        rig.settle()
        for _ in range(20):
            rig.car.measure()
            rig.sensors.measure()
            drive.command('steering')
            rig.robot.call('bus/echo')
        to_car = [codec.arduino_packet(each.type, each.data) for each in rig.car.packets]

        def matching(way: Tuple[str, int], frames: List[bytes]) -> List[bytes]:
            return [frame for frame in list(shown[way]) if frame in frames]

        for way, frames in ((('arduino', 1), to_car), *(
                ((link, 0), board.written) for link, board in boards.items())):
            with contextlib.suppress(StageError):
                rig.wait(lambda: len(matching(way, frames)) >= len(frames), '', UNTIL_PUBLISHED)
            required.check(matching(way, frames) == frames, f'{way}: {len(frames)} frames, '
                           f'{len(matching(way, frames))} of them in serial_msg')


def commands(rig: Rig) -> None:
    """Each type of command; SPEED out of its range, invalid LED texts."""
    required = rig.require('commands', 'values arrive unchanged; SPEED limited, LED text checked')
    drive = Drive(rig)
    rig.settle()
    for name, values in (('speed', (1, -2, 999, 1000, -1000)), ('steering', range(1500, 1530)),
                         ('winch', range(40000, 40010))):
        for value in values:
            drive.command(name, value)
        sent = [value for value in rig.car.commands(TYPES[name]) if value or name != 'speed']
        required.check(sent == list(values), f'{name}: {list(values)} commanded, {sent} arrived')
    for commanded, limited in ((5000, 1000), (-32768, -1000)):
        since = len(rig.car.packets)
        rig.robot.command('speed', commanded)
        required.wait(lambda: rig.car.packet(codec.SPEED, limited, since), f'SPEED {limited}')
    for text in ('left', 'x' * 31, 'x' * 30, 'ma\u00f1ana', 'disable'):
        rig.robot.command('led', text)
    required.wait(lambda: b'disable\0' in [each.data for each in rig.car.packets], 'LED disable')
    lights = [each.data for each in rig.car.packets if each.type == codec.LED]
    required.check(lights == [b'left\0', b'x' * 30 + b'\0', b'disable\0'], f'LED {lights} arrived')


def stops(rig: Rig) -> None:
    """A speed without further commands; SPEED 0; a speed while SPEED 0 is repeated."""
    in_time = rig.require('motor', 'SPEED 0 within speed_timeout + 50 ms of the last command')
    not_early = rig.require('motor', 'no SPEED 0 before speed_timeout, unless it was commanded')
    drive = Drive(rig)

    def command_once() -> Packet:
        commanded = time.monotonic()
        packet = drive.command()
        stop = in_time.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
        in_time.at_most((stop.since(packet) - PERIOD) * 1e3, (SPEED_TIMEOUT + _STOP_DELAY) * 1e3,
                        'ms', 'in heartbeats')
        not_early.check(stop.t - commanded > SPEED_TIMEOUT - 0.005,
                        f'SPEED 0 {stop.t - commanded:.3f} s after the command')
        return stop

    for _ in range(2):
        rig.settle()
        _check_repetitions(rig, command_once())
    rig.settle()
    packet = drive.command()
    rig.robot.command('speed', 0)
    _check_repetitions(rig, in_time.wait(lambda: rig.car.stop_after(packet), 'SPEED 0'))
    drive.command()
    rig.robot.command('speed', 0)
    in_time.wait(lambda: rig.car.commands(codec.SPEED)[-3:] == [0, 0, 0], 'SPEED 0 is repeated')
    command_once()        # ends the repetitions


def _check_repetitions(rig: Rig, stop: Packet) -> None:
    required = rig.require('motor', 'a SPEED 0 that ends a motion is repeated every 50 ms for 1 s')
    rig.wait(lambda: rig.car.heartbeats - rig.car.packets[-1].heartbeats > 20, 'the last SPEED 0')
    stops = rig.car.packets[rig.car.packets.index(stop):]
    required.check(all(each.is_stop for each in stops), f'another packet among {stops}')
    for before, after in zip(stops, stops[1:]):
        required.at_most((after.since(before) - PERIOD) * 1e3, _REPEAT_PERIOD * 1e3 + 10, 'ms',
                         'from one SPEED 0 to the next, in heartbeats')
    # A late read makes the first of these too short, and a late bridge the second.
    duration = max(stops[-1].t - stop.t, stops[-1].since(stop))
    required.check(duration >= _REPEAT_TIME - 2 * _REPEAT_PERIOD, f'for {duration:.3f} s only')
    required.check(stops[-1].since(stop) <= _REPEAT_TIME + 2 * _REPEAT_PERIOD,
                   f'for {stops[-1].since(stop):.2f} s, in heartbeats')


def openings(rig: Rig) -> None:
    """Unplugged while it stands or drives, and plugged in under the same name or another one."""
    first, returns = rig.require(*STOP_FIRST), rig.require(*PORT_RETURNS)
    drive = Drive(rig)
    for index in range(4):
        rig.settle()
        old = [drive.command().number] if index % 2 else []
        rig.car_line.unplug()
        old += drive.publish(5, 'speed')
        since, began = len(rig.car.packets), time.monotonic()
        rig.car_line.plug(another_name=index > 1)
        rig.wait(lambda: rig.car.heartbeats, 'heartbeats')
        returns.at_most(rig.car.heartbeat_times[0] - began, PORT_RETURN, 's', 'arduino')
        rig.wait_heartbeats(_HEARTBEATS_AFTER)
        packet = rig.car.first[rig.car.connection]
        first.check(packet.is_stop, f'the first packet was {packet}')
        drive.check_not_sent(old, 'speed', 'from before the reconnect', since)
        drive.command()


def old_stamps(rig: Rig) -> None:
    """Stamps in the past and in the future."""
    required = rig.require('old commands', 'a stamp over 0.5 s off is refused, except for SPEED 0')
    drive = Drive(rig)
    rig.settle()
    for name in ('speed', 'steering'):
        for age in (_AGE, 3600.0, -_AGE, -3600.0):
            old = drive.next_number()
            rig.robot.command(name, old, time.time() - age)
            drive.command(name)         # on the same connection
            required.check(rig.car.packet(TYPES[name], old) is None,
                           f'{name} with a stamp {age:g} s old arrived')
        value = drive.next_number()
        rig.robot.command(name, value, time.time())
        required.wait(lambda: rig.car.packet(TYPES[name], value), f'{name} with the present time')
    for age in (3600.0, -3600.0):
        packet = drive.command()
        rig.robot.command('speed', 0, time.time() - age)
        stop = required.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
        required.check(stop.since(packet) < SPEED_TIMEOUT - 0.05,
                       f'SPEED 0 with a stamp {age:g} s old was refused')


def latched(rig: Rig) -> None:
    """A latching publisher connects, ends, and another one connects under its name."""
    required = rig.require(*LATCHED)
    rig.settle()
    for first, second, accepted in ((101, 102, True), (201, 202, False)):
        child = rig.user('latching', 'latching', first, second)
        child.order('next')     # on the same connection
        required.wait(lambda: rig.car.packet(codec.SPEED, second), 'the second speed arrives')
        times = rig.car.commands(codec.SPEED).count(first)
        required.check(times == accepted, f'the latched speed {first} arrived {times} times')
        rig.end(child)


def old_connection(rig: Rig) -> None:
    """Two publishers with the same name: the older one is suspended, and continues."""
    required = rig.require('old commands', 'only the newest connection of each publisher is used')
    rig.settle()
    older = rig.user('speeds', 'same_name', 100)
    required.wait(lambda: rig.car.commands(codec.SPEED), 'speeds of the first one')
    older.hold()
    newer = rig.user('speeds', 'same_name', 500)
    required.wait(lambda: max(rig.car.commands(codec.SPEED)) >= 500, 'speeds of the second one')
    since = len(rig.car.packets)
    rig.wait_heartbeats(10)
    older.send(signal.SIGCONT)
    rig.wait_heartbeats(_HEARTBEATS_AFTER)
    sent = [value for value in rig.car.commands(codec.SPEED, since) if 0 < value < 500]
    required.check(not sent, f'{sent} arrived from the old connection')
    for child in (newer, older):
        rig.end(child)


def frozen(rig: Rig) -> None:
    """The board reads nothing and the line is full, while commands are published."""
    required = rig.require('motor', 'SPEED 0 is the first packet after dropped output')
    drive = Drive(rig)
    for _ in range(2):
        rig.settle()
        drive.command()
        with rig.suspended():
            rig.car_line.freeze()
        since, heartbeats, old = len(rig.car.packets), rig.car.heartbeats, []
        for index in range(20):     # dropping bytes frees space for new ones, until `fill`
            old += drive.publish(index < 12, 'speed')
            rig.sleep(0.05)
            rig.car_line.fill()
        rig.car_line.thaw()
        rig.wait_heartbeats(_HEARTBEATS_AFTER)
        _check_stop_first(rig, required, since, heartbeats)
        drive.check_not_sent(old, 'speed', 'commanded while the line was frozen', since)
        drive.command_until_accepted()


def _check_stop_first(rig: Rig, required: Requirement, since: int, heartbeats: int) -> None:
    """Check that SPEED 0 is the first packet after so many others and so many heartbeats."""
    packets = rig.car.packets[since:]
    number = packets[0].heartbeats - heartbeats if packets else 0
    required.check(packets and packets[0].is_stop and not number,
                   f'first {number} heartbeats, then {packets[:2]}')


def suspended_bridge(rig: Rig) -> None:
    """SIGSTOP of the bridge, while commands and data are sent."""
    first = rig.require('motor', 'SPEED 0 is the first packet after a stall of over 0.5 s')
    stale = rig.require('data', 'bytes that waited during a stall are dropped, counted as stale')
    returns = rig.require('data', 'data is published again after a stall (time in heartbeats)')
    drive, names = Drive(rig), ('speed', 'steering', 'winch')
    for _ in range(2):
        rig.settle()
        car, mcu = {'stale': 0}, {'stale': 0}
        with rig.counted(stale, 'arduino', car), rig.counted(stale, 'mcu', mcu):
            drive.command()
            old: List[int] = []
            with rig.suspended():
                since, heartbeats = len(rig.car.packets), rig.car.heartbeats
                for _ in range(6):
                    old += drive.publish(1, *names)
                    rig.car.measure()
                    rig.sensors.measure()
                    rig.sleep(_STALL / 6 - 0.05)
            rig.wait_heartbeats(_HEARTBEATS_AFTER)
            car['stale'] = len(b''.join(rig.car.written))
            mcu['stale'] = len(b''.join(rig.sensors.written))
        _check_stop_first(rig, first, since, heartbeats)
        for name in names:
            drive.check_not_sent(old, name, 'commanded while the bridge was suspended', since)
        for topic in {each.topic for each in rig.car.sent + rig.sensors.sent}:
            keys = [each.key for each in rig.robot.published[topic] if each.key is not None]
            stale.check(not keys, f'{topic}: {keys[:3]} were published')
        heartbeats = rig.car.heartbeats
        rig.wait_for_data('~counter', rig.car.measure, returns)
        returns.keep_worst((rig.car.heartbeats - heartbeats) * PERIOD, 's')
        drive.command_until_accepted()


def calibration(rig: Rig) -> None:
    """The board does not read while it calibrates, so nothing is sent to it."""
    required = rig.require('motor', 'SPEED 0 precedes a calibration; nothing is sent during it')
    over = rig.require('commands', 'a calibration ends with the first IMU data after a silence')
    drive = Drive(rig)
    for moves in (True, False):
        rig.settle()
        if moves:
            drive.command()
        rig.robot.call('calibrate_imu')
        request = required.wait(lambda: [each for each in rig.car.packets
                                         if each.type == codec.CALIBRATION], 'the request')[0]
        at = rig.car.packets.index(request)
        required.check(not moves or rig.car.packets[at - 1].is_stop,
                       f'the packet before it was {rig.car.packets[at - 1:at]}')
        rig.car.measure()           # the IMU packet that was on its way when it began
        drive.publish(46, *TYPES)
        rig.wait_heartbeats(10)
        required.check(len(rig.car.packets) == at + 1,
                       f'{rig.car.packets[at + 1:at + 3]} were sent during it')
        rig.car.measure()
        over.check(drive.command_until_accepted(), '')


def damaged(rig: Rig) -> None:
    """Invalid packets, each between valid ones."""
    required = rig.require(*ERRORS_COUNTED)
    invalid = (
        ('framing errors', b'\x09\x01\x02\x00'),
        ('length errors', codec.arduino_packet(codec.TICKS, b'\1\2')),
        ('unknown type errors', codec.arduino_packet(200, b'abc')),
        ('implausible errors', codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', 300.0))),
        ('implausible errors', codec.arduino_packet(codec.IMU, bytes(22))),
        ('implausible errors', codec.arduino_packet(codec.STEERING_ANGLE, b'\xFF\xFF')),
        ('oversize errors', b'\x01' * 300 + b'\0'))
    rig.settle()
    keys = [key for key, _packet in invalid]
    with rig.counted(required, 'arduino', {key: keys.count(key) for key in keys}):
        for _key, packet in invalid:
            rig.car.measure()
            rig.car_line.write(packet)
            rig.car.measure()
        rig.compare(rig.car)


SCENARIOS = (measurements, traffic, commands, stops, openings, old_stamps, latched, old_connection,
             frozen, suspended_bridge, calibration, damaged)
