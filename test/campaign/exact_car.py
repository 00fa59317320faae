"""The model car, exactly: compares the packets that it received with what was commanded."""
import contextlib
import os
import signal
import struct
import termios
import time
from collections import defaultdict
from typing import Any, Dict, Iterable, List, Tuple

import by_definition as codec
from processes import StageError
from serial_communication.msg import SerialMsg
from .boards import ALIVE, BLOB, HEATER, WINCH, Packet
from .exact_bus import NOISE
from .requirements import Requirement
from .rig import (ERRORS_COUNTED, LATCHED, PORT_RETURN, PORT_RETURNS, SPEED_TIMEOUT, STOP_FIRST,
                  UNTIL_PUBLISHED, Rig)
from .robot import COMMANDS, WITH_STAMP

TYPES = {'speed': codec.SPEED, 'steering': codec.STEERING, 'led': codec.LED, 'winch': WINCH,
         'heater': HEATER}
_STOP_DELAY = 0.05       # s that SPEED 0 may be sent later than speed_timeout
_REPEAT_PERIOD = 0.05    # s
_REPEAT_TIME = 1.0       # s
_AGE = 0.8               # s, over arduino/command_age
_AFTER = 0.6             # s until a packet that must not arrive would have arrived


class Drive:
    """Publishes commands with unique numbers."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.arrives = rig.row('every command reaches the board of an open port')
        self.no_old = rig.row('no command from before a reconnect, stall or restart')
        self._number = 0

    def next_number(self) -> int:
        self._number += 1
        return self._number

    def command(self, name: str = 'speed', value: int = 0) -> Packet:
        """Publish this value, or else the next number; return its packet once it arrives."""
        value, since = value or self.next_number(), len(self.rig.car.packets)
        self.rig.robot.command(name, value)
        return self.arrives.wait(lambda: self.rig.car.packet(TYPES[name], value, since), name)

    def publish(self, times: int, names: Iterable[str] = COMMANDS,
                pause: float = 0.05) -> List[int]:
        """Publish the next numbers as these commands, without waiting for them; return them."""
        values = [self.next_number() for _ in range(times)]
        for value in values:
            for name in names:
                self.rig.robot.command(name, value)
            self.rig.sleep(pause)
        return values

    def command_until_accepted(self) -> Packet:
        """Publish new speeds until the bridge sends one of them."""
        rig, since, first = self.rig, len(self.rig.car.packets), self._number + 1

        def accepted() -> Any:
            rig.robot.command('speed', self.next_number())
            rig.wait_beats(0.03)
            return [each for each in rig.car.packets[since:]
                    if each.type == codec.SPEED and each.number >= first]
        return self.arrives.wait(accepted, 'a command arrives again')[0]

    def check_not_sent(self, values: List[int], what: str, since: int = 0) -> None:
        """Check that none of these numbers arrived as a command of any type."""
        for name in COMMANDS:
            sent = set(self.rig.car.commands(TYPES[name], since)) & set(values)
            self.no_old.check(not sent, f'{name} {sorted(sent)}, {what}, reached the board')


def measurements(rig: Rig) -> None:
    """All types of messages of the car and the sensor board, a hundred of each."""
    rate = rig.row('heartbeats: 100 a second')
    rig.settle()
    began, beats = time.monotonic(), rig.car.all_beats
    for number in range(100):
        rig.measure()
        rig.sensors.cliff()
        if number % 10 == 0:
            size = 246 + number // 10       # with the type 247 … 256 bytes
            rig.car.send(codec.arduino_packet(BLOB, bytes(1 + n % 255 for n in range(size))))
        rig.wait_beats(0.05)
    seconds = time.monotonic() - began
    beats = rig.car.all_beats - beats
    rate.check(abs(beats / seconds - 100) < 2, f'{beats} in {seconds:.3f} s')
    rig.compare(rig.car, rig.sensors)


def noise(rig: Rig) -> None:
    """200 bytes of noise before a good frame."""
    for _ in range(3):
        rig.settle()
        for board in (rig.car, rig.sensors):
            board.line.write(NOISE + (b'\0' if board is rig.car else b''))
            board.measure()
        rig.compare(rig.car, rig.sensors)


def traffic(rig: Rig) -> None:
    """What serial_msg and /diagnostics show, compared with the frames on the lines."""
    required = rig.row('serial_msg has every received and sent frame once, in order')
    counters = rig.row('the counters in /diagnostics are exact')
    drive = Drive(rig)
    shown: Dict[Tuple[str, int], List[SerialMsg]] = defaultdict(list)   # by link and direction
    subscriber = rig.robot.subscribe_to_traffic(
        lambda message: shown[message.link, message.direction].append(message))
    # Until each link has shown frames.
    rig.wait(lambda: not rig.measure() and rig.robot.call('bus/echo').success and len(shown) >= 5,
             'serial_msg')
    rig.settle()
    wanted = {'frames received': 40, 'framing errors': 20, 'checksum errors': 0,
              'bytes received': 0}
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
             codec.arduino_at), *((board.line.name, 0, board.written, board.sent_frame_at)
                                  for board in (rig.car, rig.sensors, rig.bus))):
        frames = [frame for frame in frames         # signs of life are all the same
                  if b'damaged' not in frame and frame != codec.arduino_packet(ALIVE)]

        def found() -> List[SerialMsg]:
            return [each for each in list(shown[link, direction]) if bytes(each.frame) in frames]
        with contextlib.suppress(StageError):
            rig.wait(lambda: len(found()) >= len(frames), '', UNTIL_PUBLISHED)
        required.check([bytes(each.frame) for each in found()] == frames,
                       f'{link} {direction}: {len(frames)} frames, {len(found())} in serial_msg')
        for each in found():
            content = codec.decode(bytes(each.frame), frame_at)[0][0].content
            required.check(content == (each.type, each.command, bytes(each.data))
                           and each.text and not each.error, f'{each}')
    errors = b''.join(bytes(each.frame) for each in shown['mcu', 0] if each.error)
    required.check(errors.count(b'damaged') == 20, 'not all damaged frames are shown')
    subscriber.unregister()
    for link, line in rig.lines.items():
        counters.check(rig.next_report(link)[2]['hardware id'] == line.port, f'port of {link}')


def settings(rig: Rig) -> None:
    """Another program changes the settings of the port (stty icrnl)."""
    required = rig.row('changed settings of a tty are restored within 0.3 s')
    for _ in range(2):
        rig.settle()
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


def commands(rig: Rig) -> None:
    """Each type of command, one by one and in a burst; SPEED out of range, invalid LED texts."""
    required = rig.row('values arrive unchanged; SPEED limited, LED text checked')
    burst = rig.row('of a burst of commands each arrives at most once, in order, and the last')
    drive = Drive(rig)
    rig.settle()
    for name, values in (('speed', (1, -2, 999, 1000, -1000)), ('steering', range(1500, 1530)),
                         ('winch', range(40000, 40010)), ('heater', range(256, 266)),
                         ('led', range(10, 20))):
        for value in values:
            drive.command(name, value)
        sent = [value for value in rig.car.commands(TYPES[name]) if value]
        required.check(sent == list(values), f'{name}: {sent} arrived')
    for commanded, limited in ((5000, 1000), (-32768, -1000)):
        since = len(rig.car.packets)
        rig.robot.command('speed', commanded)
        required.wait(lambda: rig.car.packet(codec.SPEED, limited, since), f'SPEED {limited}')
    for name in COMMANDS:
        since = len(rig.car.packets)
        values = drive.publish(30, [name], 0.0 if name != 'led' else 0.01)
        burst.wait(lambda: rig.car.packet(TYPES[name], values[-1], since), f'the last {name}')
        sent = [value for value in rig.car.commands(TYPES[name], since) if value > 0]
        burst.check(sent == sorted(set(sent)) and set(sent) <= set(values), f'{name}: {sent}')
    since = len(rig.car.packets)
    for text in ('left', 'x' * 31, 'x' * 30, 'ma\u00f1ana', 'disable'):
        rig.robot.command('led', text)
    required.wait(lambda: b'disable\0' in [each.data for each in rig.car.packets], 'LED disable')
    lights = [each.data for each in rig.car.packets[since:] if each.type == codec.LED]
    required.check(lights == [b'left\0', b'x' * 30 + b'\0', b'disable\0'], f'LED {lights} arrived')


def stops(rig: Rig) -> None:
    """A speed without further commands; SPEED 0; a speed while SPEED 0 is repeated."""
    in_time = rig.row('SPEED 0 within speed_timeout + 50 ms of the last command')
    not_early = rig.row('no SPEED 0 before speed_timeout, unless it was commanded')
    drive = Drive(rig)

    def command_once() -> Packet:
        packet = drive.command()
        stop = in_time.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
        rig.in_time(in_time, packet.t, stop.t, SPEED_TIMEOUT + _STOP_DELAY, '')
        rig.in_time(not_early, packet.t, stop.t, 9.0, '', SPEED_TIMEOUT - 0.01)
        return stop

    for _ in range(3):
        rig.settle()
        check_repetitions(rig, command_once())
    for _ in range(2):
        rig.settle()
        packet = drive.command()
        rig.robot.command('speed', 0)
        stop = in_time.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
        rig.in_time(in_time, packet.t, stop.t, 0.2, 'commanded')
        check_repetitions(rig, stop)
    drive.command()
    rig.robot.command('speed', 0)
    in_time.wait(lambda: rig.car.commands(codec.SPEED)[-3:] == [0, 0, 0], 'SPEED 0 is repeated')
    command_once()        # ends the repetitions


def check_repetitions(rig: Rig, stop: Packet) -> None:
    required = rig.row('a SPEED 0 that ends a motion is repeated every 50 ms for 1 s')
    rig.wait(lambda: time.monotonic() > rig.car.packets[-1].t + 0.2, 'the last SPEED 0')
    stops = rig.car.packets[rig.car.packets.index(stop):]
    required.check(all(each.is_stop for each in stops), f'another packet among {stops}')
    for before, after in zip(stops, stops[1:]):
        rig.in_time(required, before.t, after.t, _REPEAT_PERIOD + 0.015, 'to the next SPEED 0')
    rig.in_time(required, stop.t, stops[-1].t, _REPEAT_TIME + 0.1, 'all', _REPEAT_TIME - 0.1)


def check_first(rig: Rig) -> Packet:
    """Check, and return, the first packet of this connection."""
    packet = rig.car.first[rig.car.connection]
    rig.row(STOP_FIRST).check(packet.is_stop, f'the first packet was {packet}')
    return packet


def openings(rig: Rig) -> None:
    """Unplugged while it stands or drives, and plugged in under the same name or another one."""
    returns, drive = rig.row(PORT_RETURNS), Drive(rig)
    for index in range(4):
        rig.settle()
        old = [drive.command().number] if index % 2 else []
        rig.car_line.unplug()
        old += drive.publish(5)
        if not index:
            rig.diagnosed('arduino', 2, 'closed')
            rig.row(STOP_FIRST).check(not rig.robot.call('calibrate_imu').success,
                                      'a closed port calibrates')
        since, began = len(rig.car.packets), time.monotonic()
        rig.car_line.plug(another_name=index > 1)
        rig.wait(lambda: rig.car.beats, 'heartbeats')
        returns.at_most(rig.car.first_beat - began, PORT_RETURN, 's', 'arduino')
        rig.wait_beats(_AFTER)
        check_repetitions(rig, check_first(rig))
        drive.check_not_sent(old, 'from before the reconnect', since)
        drive.command_until_accepted()
    rig.diagnosed('arduino', 0, 'open')


def old_stamps(rig: Rig) -> None:
    """Stamps in the past and in the future."""
    required = rig.row('a stamp over 0.5 s off is refused, except for SPEED 0')
    drive = Drive(rig)
    rig.settle()
    for name in WITH_STAMP:
        for age in (_AGE, 3600.0, -_AGE, -3600.0):
            old = drive.next_number()
            rig.robot.command(name, old, time.time() - age)
            drive.command(name)         # on the same connection
            arrived = rig.car.packet(TYPES[name], old)
            required.check(not arrived, f'{name} with a stamp {age:g} s old arrived')
        for age in (0.0, 0.3, -0.3):
            value = drive.next_number()
            rig.robot.command(name, value, time.time() - age)
            required.wait(lambda: rig.car.packet(TYPES[name], value), f'{name}, {age:g} s old')
    for age in (3600.0, -3600.0):
        packet = drive.command()
        rig.robot.command('speed', 0, time.time() - age)
        stop = required.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
        required.check(stop.t - packet.t < SPEED_TIMEOUT - 0.05, f'SPEED 0, {age:g} s old')


def latched(rig: Rig) -> None:
    """A latching publisher connects, ends, and another one connects under its name."""
    required = rig.row(LATCHED)
    rig.settle()
    for first, second, accepted in ((101, 102, True), (201, 202, False), (0, 302, True)):
        since = len(rig.car.packets)
        child = rig.user('latching', 'latching', first, second)
        child.order('next')     # on the same connection
        for name, type_ in TYPES.items():
            required.wait(lambda: rig.car.packet(type_, second, since), f'the second {name}')
            times = rig.car.commands(type_, since).count(first)
            if first or name == 'speed':        # a latched SPEED 0 is accepted, others are not
                required.check(bool(times) == accepted, f'{name} {first} arrived {times} times')
        rig.end(child)


def old_connection(rig: Rig) -> None:
    """Two publishers with the same name: the older one is suspended, and continues."""
    required = rig.row('only the newest connection of each publisher is used')
    rig.settle()
    children = []
    for number in 100, 500:
        for child in children:
            child.hold()
        children.append(rig.user('numbers', 'same_name', number))
        for name, type_ in TYPES.items():
            required.wait(lambda: max(rig.car.commands(type_), default=0) >= number, name)
    since = len(rig.car.packets)
    rig.wait_beats(0.1)
    children[0].send(signal.SIGCONT)
    rig.wait_beats(_AFTER)
    for name, type_ in TYPES.items():
        sent = [value for value in rig.car.commands(type_, since) if 0 < value < 500]
        required.check(not sent, f'{name} {sent} arrived from the old connection')
    for child in reversed(children):
        rig.end(child)


def frozen(rig: Rig) -> None:
    """The board reads nothing and the line is full, while commands are published."""
    required = rig.row('SPEED 0 is the first packet after dropped output')
    drive = Drive(rig)
    for _ in range(2):
        rig.settle()
        drive.command()
        with rig.suspended():
            rig.car_line.freeze()
        since, beats, old = len(rig.car.packets), rig.car.beats, []
        for index in range(20):     # dropping bytes frees space for new ones, until `fill`
            old += drive.publish(index < 12)
            rig.sleep(0.05)
            rig.car_line.fill()
        rig.car.forget_beat()
        rig.car_line.thaw()
        rig.wait_beats(_AFTER)
        _check_stop_first(rig, required, since, beats)
        drive.check_not_sent(old, 'commanded while the line was frozen', since)
        drive.command_until_accepted()


def unheard(rig: Rig) -> None:
    """The board reads and sends nothing, but the line takes everything: a pty behind which a
    program hangs."""
    required = rig.row('no command that waited unseen in a pty for over 1.5 s arrives')
    drive = Drive(rig)
    for _ in range(2):
        rig.settle()
        drive.command()
        rig.car.talks = False
        rig.car_line.hang()
        since, commanded = len(rig.car.packets), {}
        for _ in range(50):
            number = drive.publish(1)[0]
            commanded[number] = time.monotonic()
        rig.car_line.thaw()
        rig.car.forget_beat()
        rig.car.talks = True
        rig.wait_beats(_AFTER)
        late = [packet.t - commanded[packet.number] for packet in rig.car.packets[since:]
                if packet.number in commanded]
        required.at_most(max(late, default=0.0), 1.5, 's', f'{len(late)} commands arrived')
        drive.command_until_accepted()


def _check_stop_first(rig: Rig, required: Requirement, since: int, beats: int) -> None:
    """Check that SPEED 0 is the first packet after so many others and so many heartbeats."""
    first = rig.car.packets[since:since + 1]
    required.check([(each.is_stop, each.beats) for each in first] == [(True, beats)],
                   f'first {first}, {beats} heartbeats before')


def stalls(rig: Rig) -> None:
    """SIGSTOP of the bridge, while commands and data are sent."""
    first = rig.row('SPEED 0 is the first packet after a stall of over 0.5 s')
    stale = rig.row('bytes that waited during a stall are dropped, counted as stale')
    returns = rig.row('data is published again within 1 s of a stall')
    short = rig.row('a stall of 0.2 s loses nothing')
    drive = Drive(rig)
    for seconds in (0.2, 0.4, 0.7, 1.2):
        rig.settle()
        car, mcu = {'stale': 0}, {'stale': 0}
        with rig.counted(stale, 'arduino', car), rig.counted(stale, 'mcu', mcu):
            drive.command()
            rig.car.talks = False
            if seconds < 0.3:       # a link's thread may sleep for 0.1 s; these bytes wake it up
                rig.measure()
            with rig.suspended() as held_at:
                since, beats = len(rig.car.packets), rig.car.beats
                if seconds > 0.3:
                    rig.car.sent.clear()
                    rig.car.written.clear()
                old = drive.publish(2, pause=0.0)
                for number in range(1, 5):
                    rig.measure()
                    rig.sleep(held_at + seconds * number / 4 - time.monotonic())
            rig.wait_beats(_AFTER)
            if seconds > 0.3:
                car['stale'] = len(b''.join(rig.car.written))
                mcu['stale'] = len(b''.join(rig.sensors.written))
        rig.car.talks = True
        if seconds < 0.3:
            rig.compare(rig.car, rig.sensors)
            short.check(rig.car.packet(codec.SPEED, old[-1], since), 'the newest speed is lost')
            continue
        if seconds > 0.5:
            _check_stop_first(rig, first, since, beats)
            drive.check_not_sent(old, 'commanded while the bridge was suspended', since)
        for topic in {each.topic for each in rig.car.sent + rig.sensors.sent}:
            published = [each.key is not None for each in rig.robot.published[topic]]
            stale.check(not any(published), f'{topic} was published')
        began = time.monotonic()
        rig.wait_for_data('~counter', rig.car.measure, returns)
        returns.at_most(time.monotonic() - began, 1.0, 's', f'{seconds:g} s')
        drive.command_until_accepted()


def calibration(rig: Rig) -> None:
    """The board does not read while it calibrates, so nothing is sent to it."""
    required = rig.row('SPEED 0 precedes a calibration; nothing is sent during it')
    over = rig.row('a calibration ends with the first IMU data after a silence of 2 s')
    drive = Drive(rig)
    for moves in (True, False):
        rig.settle()
        rig.car.talks = False
        if moves:
            drive.command()
        rig.robot.call('calibrate_imu')
        request = required.wait(lambda: [each for each in rig.car.packets
                                         if each.type == codec.CALIBRATION], 'the request')[0]
        at = rig.car.packets.index(request)
        before = rig.car.packets[at - 1]
        required.check(not moves or before.is_stop, f'the packet before it was {before}')
        rig.car.measure()           # the IMU packet that was on its way when it began
        drive.publish(28)
        rig.car.measure()           # after 1.5 s: it was in the network
        drive.publish(43)
        rig.wait_beats(0.1)
        sent = rig.car.packets[at + 1:]
        required.check(not sent, f'{sent[:2]} were sent during it')
        rig.diagnosed('arduino', 1, 'calibrating')
        rig.car.measure()
        over.check(drive.command_until_accepted(), '')
        said = [each.message.data for each in rig.robot.published['~imu/calibrating']]
        over.check(said == [True, False], f'~imu/calibrating: {said}')
        rig.car.talks = True


def calibration_in_a_stall(rig: Rig) -> None:
    """A calibration that was called while the bridge was suspended."""
    required = rig.row('a call from the time of a stall, or 0.5 s after it, is not sent')
    for _ in range(2):
        rig.settle()
        with rig.suspended():
            future = rig.robot.start_call('calibrate_imu')
            rig.sleep(0.7)
        outcome = future.result()
        sent = [each for each in rig.car.packets if each.type == codec.CALIBRATION]
        required.check(not outcome.success and not sent, f'calibrate_imu: {outcome}')
        if sent:        # end the calibration
            rig.sleep(2.2)
            rig.car.measure()


def damaged(rig: Rig) -> None:
    """Invalid packets, each between valid ones."""
    required = rig.row(ERRORS_COUNTED)
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
        rig.diagnosed('arduino', 1, 'errors in the last second')
        rig.compare(rig.car)


SCENARIOS = (measurements, noise, traffic, settings, commands, stops, openings, old_stamps, latched,
             old_connection, frozen, unheard, stalls, calibration, calibration_in_a_stall, damaged)
