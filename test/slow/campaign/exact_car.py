"""The model car, exactly: compares the packets that it received with what was commanded."""
import signal
import time
from typing import Any, Iterable, List

import by_definition as codec
from .boards import HEATER, WINCH, Packet
from .rig import AFTER, LATCHED, SPEED_TIMEOUT, STOP_FIRST, Rig
from .robot import COMMANDS, NODE, WITH_STAMP

TYPES = {'speed': codec.SPEED, 'steering': codec.STEERING, 'led': codec.LED, 'winch': WINCH,
         'heater': HEATER}
STAMPED = 'a stamp over 0.5 s off is refused, except for SPEED 0'
STOPS = 'SPEED 0 within speed_timeout + 50 ms of the last command'
_STOP_DELAY = 0.05      # s that SPEED 0 may be sent later than speed_timeout
_REPEAT_PERIOD = 0.05    # s
_REPEAT_TIME = 1.0       # s
_GOES_ON = 5.0           # s
CALIBRATION_TIMEOUT = 8.0       # s: a parameter of one bridge
_BEFORE = 'SPEED 0 precedes a calibration; nothing is sent during it'
_OVER = 'a calibration ends with the first IMU data after a silence of 2 s'
_AGE = 0.8               # s, over arduino/command_age
SILENT = 'arduino: the board is silent'     # in the log


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


def commands(rig: Rig) -> None:
    """Each type of command, one by one and in a burst; SPEED out of range, invalid LED texts."""
    required = rig.row('values arrive unchanged; SPEED limited, LED text checked')
    burst = rig.row('of a burst of commands each arrives at most once, in order, and the last')
    drive = Drive(rig)
    for name, values in (
            ('speed', (1, -2, 999, 1000, -1000)), ('steering', (*range(1500, 1530), 65535)),
            ('winch', range(40000, 40010)), ('heater', range(256, 266)), ('led', range(10, 20))):
        for value in values:
            drive.command(name, value)
        sent = [value for value in rig.car.commands(TYPES[name]) if value]
        required.check(sent == list(values), f'{name}: {sent} arrived')
    rig.robot.command('heater', 50000)      # over the maximum of its row
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
    for text in ('left', 'x' * 31, 'x' * 30, 'ma\u00f1ana', 'a\0b', 'disable'):
        rig.robot.command('led', text)
    required.wait(lambda: b'disable\0' in [each.data for each in rig.car.packets], 'LED disable')
    required.check(50000 not in rig.car.commands(HEATER), 'a heater over its maximum arrived')
    lights = [each.data for each in rig.car.packets[since:] if each.type == codec.LED]
    required.check(lights == [b'left\0', b'x' * 30 + b'\0', b'disable\0'], f'LED {lights} arrived')


def stops(rig: Rig) -> None:
    """A speed without further commands; SPEED 0; a speed while SPEED 0 is repeated."""
    in_time = rig.row(STOPS)
    not_early = rig.row('no SPEED 0 before speed_timeout, unless it was commanded')
    drive = Drive(rig)

    def command_once(value: int = 0) -> Packet:
        packet = drive.command('speed', value)
        stop = check_timeout(rig, packet)
        rig.in_time(not_early, packet.t, stop.t, 9.0, '', SPEED_TIMEOUT - 0.01)
        return stop

    for value in rig.tries(0, -700, 0):
        check_repetitions(rig, command_once(value))
    for _ in rig.tries(*range(2)):
        packet = drive.command()
        rig.robot.command('speed', 0)
        stop = in_time.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
        rig.in_time(in_time, packet.t, stop.t, 0.2, 'commanded')
        drive.publish(10, ['steering', 'led'])
        check_repetitions(rig, stop)
    drive.command()
    rig.robot.command('speed', 0)
    in_time.wait(lambda: rig.car.commands(codec.SPEED)[-3:] == [0, 0, 0], 'SPEED 0 is repeated')
    command_once()        # ends the repetitions
    rig.settle()
    drive.publish(25, ['steering', 'led'])
    not_early.check(not rig.car.commands(codec.SPEED), 'a SPEED among other commands')
    packet = drive.command()
    drive.publish(15, ['steering', 'led', 'winch', 'heater'])
    check_timeout(rig, packet)
    drive.publish(25)
    for _ in range(25):         # the same one each time, as of a joystick that is held
        rig.robot.command('speed', 700)
        rig.sleep(0.05)
    speeds = [each for each in rig.car.packets if each.type == codec.SPEED]
    for before, after in zip(speeds, speeds[1:]):
        if after.is_stop and not before.is_stop:
            rig.in_time(not_early, before.t, after.t, 9.0, 'between speeds', SPEED_TIMEOUT - 0.01)
    not_early.check(True, '')       # also if there was none


def check_timeout(rig: Rig, packet: Packet) -> Packet:
    """Check, and return, the SPEED 0 that follows this speed without further ones."""
    required = rig.row(STOPS)
    stop: Packet = required.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
    rig.in_time(required, packet.t, stop.t, SPEED_TIMEOUT + _STOP_DELAY, f'{packet}')
    return stop


def check_repetitions(rig: Rig, stop: Packet) -> None:
    required = rig.row('a SPEED 0 that ends a motion is repeated every 50 ms for 1 s')
    rig.wait_beats(_REPEAT_TIME + 0.15, stop.t)
    packets = rig.car.packets[rig.car.packets.index(stop):]
    stops = [each for each in packets if each.type == codec.SPEED]
    required.check(all(each.is_stop for each in stops), f'another speed among {stops}')
    for before, after in zip(stops, stops[1:]):
        rig.in_time(required, before.t, after.t, _REPEAT_PERIOD + 0.015, 'to the next SPEED 0')
    rig.in_time(required, stop.t, stops[-1].t, _REPEAT_TIME + 0.1, 'all', _REPEAT_TIME - 0.1)


def check_not_silent(rig: Rig, before: int) -> None:
    """Check that the log has no more lines than so many that the car is silent."""
    rig.row('what happened is in the log').check(
        len(rig.logs.find(SILENT)) == before, 'the log says that the board is silent')


def check_first(rig: Rig) -> Packet:
    """Check, and return, the first packet of this connection."""
    packet = rig.car.first
    rig.row(STOP_FIRST).check(packet.is_stop, f'the first packet was {packet}')
    return packet


def old_stamps(rig: Rig) -> None:
    """Stamps in the past and in the future."""
    required = rig.row(STAMPED)
    drive = Drive(rig)
    for name in WITH_STAMP:
        for age in (_AGE, 3600.0, -_AGE, -3600.0):
            old = drive.next_number()
            rig.robot.command(name, old, time.time() - age)
            rig.sleep(0.05)             # else the next one may take its place
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
    name = f'latching_{time.monotonic_ns()}'    # one that the bridge does not know from another try
    for first, second, accepted in rig.tries((101, 102, True), (201, 202, False), (0, 302, True)):
        since = len(rig.car.packets)
        child = rig.user('latching', name, first, second)
        child.order('next')     # on the same connection
        for topic, type_ in TYPES.items():
            required.wait(lambda: rig.car.packet(type_, second, since), f'the second {topic}')
            arrived = rig.car.commands(type_, since)
            times = arrived[:arrived.index(second)].count(first)
            if first or topic == 'speed':       # a latched SPEED 0 is accepted, others are not
                required.check(bool(times) == accepted, f'{topic} {first} arrived {times} times')
            Drive(rig).command(topic, 900)      # from another publisher, with an older connection
        rig.end(child)


def old_connection(rig: Rig) -> None:
    """Two publishers with the same name: the older one is suspended, and continues."""
    required = rig.row('only the newest connection of each publisher is used')
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
    required.wait(lambda: rig.logs.find('refused: .*old connection'), 'it is logged')
    rig.wait_beats(AFTER)
    for name, type_ in TYPES.items():
        sent = [value for value in rig.car.commands(type_, since) if 0 < value < 500]
        required.check(not sent, f'{name} {sent} arrived from the old connection')
    for child in reversed(children):
        rig.end(child)


def calibration(rig: Rig) -> None:
    """The board does not read while it calibrates, so nothing is sent to it."""
    required, over = rig.row(_BEFORE), rig.row(_OVER)
    drive, silences = Drive(rig), len(rig.logs.find(SILENT))
    for moves in rig.tries(True, False):
        if moves:
            drive.command()
        request = _begin_calibration(rig)
        at = rig.car.packets.index(request)
        before = rig.car.packets[at - 1]
        required.check(not moves or before.is_stop, f'the packet before it was {before}')
        rig.car.measure()           # the IMU packet that was on its way when it began
        drive.publish(28)
        rig.car.measure()           # after 1.5 s: it was in the network
        silent_until = time.monotonic() + 2.2
        required.check(not rig.robot.call('arduino/release', 'campaign', 1.0).success,
                       'its port is lent')
        required.check(not rig.robot.call('calibrate_imu').success, 'it calibrates twice')
        rig.diagnosed('arduino', 1, 'calibrating')
        echo = rig.child(f'echo_{moves}', [
            'rostopic', 'echo', '-n', '1', f'{NODE}/imu/calibrating'])
        over.wait(lambda: not echo.alive, 'a new subscriber is told')
        while time.monotonic() < silent_until:
            drive.publish(1)
        rig.wait_beats(0.1)
        sent = rig.car.packets[at + 1:]
        required.check(not sent, f'{sent[:2]} were sent during it')
        rig.car.measure()
        over.check(drive.command_until_accepted(), '')
        said = [each.message.data for each in rig.robot.published['~imu/calibrating']]
        over.check(said == [True, False] and 'data: True' in echo.tail(),
                   f'~imu/calibrating: {said}, to a new subscriber {echo.tail()}')
        rig.end(echo)
        rig.car.talks = True
    check_not_silent(rig, silences)


def interrupted_calibration(rig: Rig) -> None:
    """The port is opened anew, or the bridge stalls: what it observed before is no silence."""
    over = rig.row(_OVER)
    for interrupt in rig.tries(_open_again, _stall):
        _begin_calibration(rig)
        rig.sleep(1.0)
        interrupt(rig)
        rig.sleep(0.7)      # until the bridge drops nothing any more
        rig.robot.clear_records()
        rig.car.measure()
        rig.wait(lambda: rig.robot.values('~imu'), 'IMU data')
        old = Drive(rig).publish(4)
        rig.sleep(2.2)
        sent = set(rig.car.commands(codec.SPEED)) & set(old)
        over.check(not sent, f'over before a silence of 2 s ({interrupt.__name__})')
        rig.car.measure()
        over.check(Drive(rig).command_until_accepted(), '')
        rig.car.talks = True


def _open_again(rig: Rig) -> None:
    rig.car_line.unplug()
    rig.sleep(0.5)
    rig.car_line.plug()
    rig.wait(lambda: rig.car.beats, 'heartbeats')


def _stall(rig: Rig) -> None:
    with rig.suspended():
        rig.sleep(1.3)


def no_calibration(rig: Rig) -> None:
    """The board does not calibrate: its IMU data goes on."""
    required = rig.row('a calibration is over after 5 s of IMU data that goes on')
    for _ in rig.tries(*range(2)):
        request = _begin_calibration(rig)
        with rig.clock.each(0.05, rig.car.measure):
            said = rig.robot.published['~imu/calibrating']
            required.wait(lambda: False in [each.message.data for each in said], 'it is over', 10.0)
        rig.in_time(required, request.t, time.monotonic(), _GOES_ON + 0.5, 'over', _GOES_ON - 0.1)
        Drive(rig).command_until_accepted()
        rig.car.talks = True


def endless_calibration(rig: Rig) -> None:
    """The board sends no IMU data any more."""
    required = rig.row('a calibration is over after its timeout, whatever the board does')
    request = _begin_calibration(rig)
    said = rig.robot.published['~imu/calibrating']
    required.wait(lambda: False in [each.message.data for each in said], 'it is over')
    rig.in_time(required, request.t, time.monotonic(), CALIBRATION_TIMEOUT + 0.5, 'over',
                CALIBRATION_TIMEOUT - 0.1)
    rig.car.talks = True
    Drive(rig).command_until_accepted()


def _begin_calibration(rig: Rig) -> Packet:
    """Let the car fall silent, ask it to calibrate, and return the request."""
    rig.car.talks = False
    rig.robot.call('calibrate_imu')
    return rig.row(_BEFORE).wait(lambda: [
        each for each in rig.car.packets if each.type == codec.CALIBRATION], 'the request')[0]


SERIAL = commands, old_stamps, latched, old_connection, calibration
LONG = stops, interrupted_calibration, no_calibration
