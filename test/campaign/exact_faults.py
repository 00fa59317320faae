"""What waits, or is sent, while a line or the bridge does not work; and what follows.

On serial lines and behind networks, for all links: ports that disappear, lines that take nothing,
stalls of the bridge, and resets of the boards.
"""
import contextlib
import itertools
import time
from typing import Callable, Dict, Iterable, NamedTuple

import by_definition as codec
from .boards import HALT, Reaction, Request, reply_frame
from .exact_bus import QUEUE_TIME, SERVICES, Calls
from .exact_car import Drive, check_first, check_repetitions
from .exact_data import REPORTED
from .rig import AFTER, MOTION_TIMEOUT, STOP_FIRST, Rig
from .robot import COMMANDS, NOT_SENT

SYNC_FIRST = 'after a reconnect the first request is SYNC'
PORT_RETURNS = "data within 1.5 s of the port's return"
_PORT_RETURN = 1.5       # s
_NO_OLD_DATA = 'no data from the time of a stall is published over a network'
_NETWORK_RETURN = 3.0    # s
_UNSEEN = 1.5            # s: no command that has waited longer unseen reaches the board
_SILENCE = 5.0           # s: mcu/network_silence
_RESUMES = 1.0           # s


def openings(rig: Rig) -> None:
    """All ports disappear, while the car stands or drives and a call is outstanding, and return:
    later, or at once as other devices."""
    returns, sync = rig.row(PORT_RETURNS), rig.row(SYNC_FIRST)
    calls, drive = Calls(rig), Drive(rig)
    for drives, at_once in rig.tries(*itertools.product((False, True), repeat=2)):
        made = [calls.start_unanswered()]
        old = [drive.command().number] if drives else []
        for line in rig.lines.values():
            line.unplug()
        if not at_once:     # else within the speed timeout, and as other devices
            old += drive.publish(5)
            made.append(calls.start('lift'))
            calls.check(made[1], 'while unplugged', 'not sent', QUEUE_TIME)
            for link in rig.lines:
                rig.diagnosed(link, 2, 'closed')
            reports = rig.robot.published['mcu/status']
            count = len(reports)
            rig.row(REPORTED).wait(lambda: len(reports) > count, 'of a closed port', 10.0)
            rig.row(STOP_FIRST).check(not rig.robot.call('calibrate_imu').success,
                                      'a closed port calibrates')
        since, count, connection = len(rig.car.packets), len(rig.bus.requests), rig.bus.connection
        rig.bus.react = None
        with contextlib.nullcontext() if at_once else rig.counted(
                rig.row('the counters in /diagnostics are exact'), 'mcu', {'reconnects': 1}):
            began = time.monotonic()
            for line in rig.lines.values():
                line.plug(another_name=at_once)
            rig.wait_for_data('mcu/cliff', rig.sensors.cliff, returns)
            returned = time.monotonic()
            rig.wait(lambda: rig.car.beats and len(rig.bus.requests) > count, 'ports are opened')
        calls.check(made[0], 'unplugged', 'not known')
        first = rig.bus.requests[count]
        for link, at in ('mcu', returned), ('arduino', rig.car.first.t), ('bus', first.t):
            rig.in_time(returns, began, at, _PORT_RETURN, link)
        sync.check(first.cmd1 == codec.SYNC, f'the first request was {first}')
        calls.call('lift', 'after a reconnect', 'done')
        for call in made:
            calls.check_received(call.key, 0, 'from before the reconnect', connection)
        rig.wait_beats(AFTER)
        stop = check_first(rig)
        if not at_once:     # else one is held back, until the board at this pty sends something
            check_repetitions(rig, stop)
        drive.check_not_sent(old, 'from before the reconnect', since)
        drive.command_until_accepted()
    rig.diagnosed('arduino', 0, 'open')


def lent(rig: Rig) -> None:
    """All ports are lent while the car drives: until they are given back, or the loan ends."""
    stop_last = rig.row("SPEED 0 is the last packet before the car's port is lent")
    required = rig.row('a lent port is left alone, and opened again when the loan ends')
    calls, drive = Calls(rig), Drive(rig)

    def release(seconds: float) -> float:
        began = time.monotonic()
        for link in rig.lines:
            outcome = rig.robot.call(f'{link}/release', 'campaign', seconds)
            required.check(outcome.success, f'{link}/release: {outcome}')
        return began + seconds

    for seconds, is_given_back in rig.tries((9.0, True), (60.0, False)):
        lift = calls.start_unanswered()
        required.check(not rig.robot.call('bus/release', 'campaign', 1.0).success,
                       'lent while the lift moves')
        lift.result()
        required.check(not rig.robot.call('arduino/reset').success, 'a pty has no lines')
        drive.command()
        ends_at = min(release(seconds), time.monotonic() + 10.0)
        rig.car_line.drain()
        stop_last.check(rig.car.last.is_stop, f'the last packet was {rig.car.last}')
        for board in (rig.car, rig.bus):        # a pty does not show that it was closed
            board.start_connection()
        since, count = len(rig.car.packets), len(rig.bus.requests)
        old = drive.publish(5)
        rig.measure()
        calls.call('lift', 'while lent', 'not sent', 0.0)
        rig.car_line.drain()
        required.check(not rig.robot.call('arduino/release', 'another', 1.0).success
                       and not rig.robot.call('arduino/reset').success, 'lent or reset, too')
        required.check(not rig.car.first and len(rig.bus.requests) == count,
                       f'{rig.car.first} or {rig.bus.requests[count:]} was sent')
        if is_given_back:
            rig.diagnosed('arduino', 1, 'lent to campaign')
            ends_at = release(0.0)
        required.wait(lambda: rig.car.beats and len(rig.bus.requests) > count, 'they are opened')
        rig.in_time(required, ends_at, check_first(rig).t, _PORT_RETURN, f'{seconds:g} s')
        rig.row(SYNC_FIRST).check(rig.bus.requests[count].cmd1 == codec.SYNC, 'not SYNC')
        rig.wait_for_data('mcu/cliff', rig.sensors.cliff, rig.row(PORT_RETURNS))
        for topic in '~counter', 'mcu/adc_status':
            required.check(not rig.robot.values(topic), f'{topic} was published from before')
        rig.wait_beats(AFTER)
        drive.check_not_sent(old, 'commanded while the port was lent', since)
        drive.command_until_accepted()


def closed(rig: Rig) -> None:
    """The other side of a network closes the connection: with a reset, or without one."""
    returns = rig.row(PORT_RETURNS)
    for link, board in ('arduino', rig.car), ('bus', rig.bus), ('mcu', rig.sensors):
        for close in rig.lines[link].unplug, rig.lines[link].shut_down:
            connection, began = board.connection, time.monotonic()
            rig.car.forget_beat()
            close()
            returns.wait(lambda: board.connection > connection and board.line.plugged, link)
            rig.in_time(returns, began, time.monotonic(), _PORT_RETURN, f'{link} {close.__name__}')
    rig.wait(lambda: rig.car.beats, 'heartbeats')
    Drive(rig).command_until_accepted()


def silent_network(rig: Rig) -> None:
    """The sensor board's network is cut without a word."""
    required = rig.row('a network port without a byte for network_silence is opened again')
    rig.sensors.measure()
    began, connection = time.monotonic(), rig.sensors.connection + 1
    rig.mcu_line.lose_connection()
    required.wait(lambda: rig.mcu_line.plugged, 'it is opened again')
    rig.in_time(required, began, time.monotonic(), _SILENCE + _PORT_RETURN, 'mcu', _SILENCE - 0.1)
    required.check(rig.sensors.connection == connection, 'opened more than once')
    rig.wait_for_data('mcu/cliff', rig.sensors.cliff, required)


class Cut(NamedTuple):
    """How long, and how, the car's line takes nothing while commands are published."""

    seconds: float
    begin: Callable[[Rig], None]
    requirement: str                   # of the commands that waited
    oldest: float                      # s: their age at most; 0: none may arrive
    names: Iterable[str] = COMMANDS    # of these types


def _freeze(rig: Rig) -> None:
    with rig.suspended():
        rig.car_line.freeze()


def _hang(rig: Rig) -> None:
    rig.car.talks = False
    rig.car_line.hang()


_DROPPED = 'no command from before a reconnect, stall or restart'
_UNSEEN_BY = 'no command that waited unseen in a pty for over 1.5 s arrives'
_OVER_NETWORK = 'no SPEED older than 1.5 s reaches a board behind socket://'
_FROZEN = Cut(1.0, _freeze, _DROPPED, 0.0)
_HANGS = Cut(2.5, _hang, _UNSEEN_BY, _UNSEEN)
SERIAL_CUTS = _FROZEN, _FROZEN, _HANGS, _HANGS
NETWORK_CUTS = tuple(Cut(seconds, begin, _OVER_NETWORK, _UNSEEN, ['speed']) for seconds, begin in (
    (1.2, lambda rig: rig.car_line.freeze()), (3.0, lambda rig: rig.car_line.lose_connection()),
    (2.0, lambda rig: rig.car_line.freeze()), (5.0, lambda rig: rig.car_line.freeze())))


def cuts(rig: Rig) -> None:
    """The car's line takes nothing, or the board behind it reads nothing."""
    for cut in rig.tries(*(NETWORK_CUTS if rig.is_network else SERIAL_CUTS)):
        _try_cut(rig, cut)


def _try_cut(rig: Rig, cut: Cut) -> None:
    required, car, drive = rig.row(cut.requirement), rig.car, Drive(rig)
    drive.command_until_accepted()
    connection = car.connection
    cut.begin(rig)
    since, beats = len(car.packets), car.beats
    began, published = time.monotonic(), {}     # type: float, Dict[int, float]
    while time.monotonic() < began + cut.seconds:
        now = time.monotonic()
        # Dropping bytes frees space for new ones, until `fill`: at last only that is done.
        if cut is not _FROZEN or now < began + cut.seconds * 0.6:
            published[drive.publish(1, cut.names)[0]] = now
        else:
            rig.sleep(0.05)
        if cut is _FROZEN:
            rig.car_line.fill()
    car.forget_beat()
    rig.car_line.thaw()
    returned, car.talks = time.monotonic(), True
    if rig.is_network:
        returns = rig.row("heartbeats within 3 s of the network's return")
        returns.wait(lambda: car.connection > connection and car.beats > 5, 'heartbeats')
        rig.in_time(returns, returned, time.monotonic(), _NETWORK_RETURN, f'{cut.seconds:g} s')
        check_first(rig)
    else:
        rig.wait_beats(AFTER)
    if cut is _FROZEN:
        check_stop_first(rig, 'SPEED 0 is the first packet after dropped output', since, beats)
    drive.command_until_accepted()
    for packet in car.packets[since:]:
        if packet.number in published:
            required.at_most(packet.t - published[packet.number], cut.oldest, 's', f'{packet}')
    required.check(True, '')        # also if none has arrived


def check_stop_first(rig: Rig, requirement: str, since: int, beats: int) -> None:
    """Check that SPEED 0 is the first packet after so many others and so many heartbeats."""
    first = rig.car.packets[since:since + 1]
    rig.row(requirement).check([(each.is_stop, each.beats) for each in first] == [(True, beats)],
                               f'first {first}, {beats} heartbeats before')


def frozen_bus(rig: Rig) -> None:
    """The bus board reads no more, after the fence of a call; the call times out."""
    required = rig.row('a call that timed out unheard does not arrive later')
    calls = Calls(rig)
    for _ in rig.tries(*range(2)):
        def probe(request: Request) -> Reaction:
            if not rig.is_network:
                rig.bus_line.hang()     # before the reply, which lets the bridge send the move
            rig.bus.write(rig.bus.ok_reply(request))
            if rig.is_network:
                rig.bus_line.hang()     # nothing passes any more, not even the reply
            return Reaction()
        rig.bus.probe = probe
        call = calls.start('lift')
        call.result()
        rig.bus.probe = None
        rig.sleep(0.5)
        rig.bus_line.thaw()
        rig.wait_in_step()
        rig.wait_beats(AFTER)
        calls.check(call, 'frozen', 'not known')
        required.check(not rig.bus.executed[call.key], 'the lift moved after its call had returned')


def short_stall(rig: Rig) -> None:
    """SIGSTOP of the bridge for 0.2 s, while commands and data are sent."""
    rig.car.talks = False
    rig.measure()       # wakes up links that may sleep for 0.1 s
    with rig.suspended() as held_at:
        value = Drive(rig).publish(1, pause=0.0)[0]
        for number in range(1, 5):
            rig.measure()
            rig.sleep(held_at + 0.05 * number - time.monotonic())
    rig.diagnosed('arduino', 1, 'heartbeat gap')
    rig.wait_beats(AFTER)
    rig.car.talks = True
    rig.compare(rig.car, rig.sensors)
    rig.row('a stall of 0.2 s loses nothing').check(
        rig.car.packet(codec.SPEED, value), 'the newest speed is lost')


def stalls(rig: Rig) -> None:
    """SIGSTOP of the bridge, while commands are published, services called and data sent. A reply
    and data wait; over a network they are dropped with the connection."""
    counted = rig.row('bytes that waited during a stall are dropped, counted as stale')
    for seconds in rig.tries(*((0.7, 1.5) if rig.is_network else (0.4, 0.6, 1.2))):
        stale: Dict[str, Dict[str, int]] = {
            link: {} if rig.is_network else {'stale': 0} for link in ('arduino', 'mcu')}
        with rig.counted(counted, 'arduino', stale['arduino']), \
                rig.counted(counted, 'mcu', stale['mcu']):
            _stall(rig, seconds, stale)
        Drive(rig).command_until_accepted()


def _stall(rig: Rig, seconds: float, stale: Dict[str, Dict[str, int]]) -> None:
    """Fills in how many bytes are dropped by each link."""
    old_calls = rig.row('a call from the time of a stall, or 0.5 s after it, is not sent')
    calls, drive, car = Calls(rig), Drive(rig), rig.car
    outstanding = calls.start_unanswered()
    drive.command()
    car.talks = False
    with rig.suspended() as held_at:
        since, beats, connection = len(car.packets), car.beats, car.connection
        car.sent.clear()
        car.written.clear()
        rig.bus_line.write(reply_frame(codec.OK))
        old = drive.publish(2, pause=0.0)
        calibrated = rig.robot.start_call('calibrate_imu')
        made = [calls.start(service) for service in 3 * SERVICES]   # more than six at once
        stop = rig.robot.start_call('halt')
        for number in range(1, 5):
            rig.measure()
            rig.sleep(held_at + seconds * number / 4 - time.monotonic())
        for board in car, rig.sensors:
            wanted = stale[board.line.name]
            wanted.update({key: len(b''.join(board.written)) for key in wanted})
    resumed_at, rig.bus.react = time.monotonic(), None
    made.append(calls.start('lift'))
    rig.sleep(0.25)
    made.append(calls.start('lift'))
    rig.wait_beats(AFTER)
    _check_data_after_stall(rig, resumed_at)
    car.talks = True
    calls.check(outstanding, 'stall', 'not known', MOTION_TIMEOUT + seconds)
    stopped = stop()
    if not rig.is_network:      # else the port is opened anew
        rig.row('a stop from the time of a stall is sent').check(
            stopped.success and rig.bus.count(HALT), f'{stopped}')
    for call in made:
        outcome, executed = call.result(), rig.bus.executed[call.key]
        old_calls.check(outcome.status == NOT_SENT and not executed,
                        f'{call.service}: {outcome}, executed {executed} times')
    outcome = calibrated()
    sent = [each for each in car.packets if each.type == codec.CALIBRATION]
    old_calls.check(not outcome.success and not sent, f'calibrate_imu: {outcome}')
    calls.call('lift', 'after a stall', 'done')
    if seconds > 0.5:
        drive.check_not_sent(old, 'commanded while the bridge was suspended', since)
    if rig.is_network:
        rig.row(_NO_OLD_DATA).check(car.connection > connection, 'the port was not opened anew')
        check_first(rig)
    elif seconds > 0.5:
        check_stop_first(rig, 'SPEED 0 is the first packet after a stall of over 0.5 s', since,
                         beats)


def _check_data_after_stall(rig: Rig, resumed_at: float) -> None:
    """What was sent during the stall is not published; what is sent now is."""
    required = rig.row(_NO_OLD_DATA if rig.is_network else
                       'bytes that waited during a stall are dropped, counted as stale')
    for topic in {each.topic for each in rig.car.sent + rig.sensors.sent}:
        published = rig.robot.values(topic)
        required.check(not published, f'{topic}: {published[:3]} was published')
    returns = rig.row('data is published again within 1 s of a stall')
    rig.wait_for_data('~counter', rig.car.measure, returns)
    rig.in_time(returns, resumed_at, time.monotonic(), _RESUMES, 'data')


def resets(rig: Rig) -> None:
    """Each board is reset: its current frame stays incomplete, it is silent, then starts again."""
    required = rig.row('after a reset of the board SYNC brings it in step again')
    calls = Calls(rig)
    rig.car.talks = False
    for board, incomplete in (rig.sensors, b'\x02\x0c\x10\x01'), (rig.car, b'\x05\x07\x01'):
        for _ in range(5):
            board.measure()
        board.line.write(incomplete)
    call = calls.start_unanswered()
    rig.bus.in_step, rig.bus.react = False, None
    calls.check(call, 'reset', 'not known')
    rig.sleep(0.9)
    rig.sensors.seq = 0
    for _ in range(5):
        rig.measure()
    rig.car.talks = True
    calls.call('lift', 'after a reset', 'done')
    required.check(rig.bus.in_step, 'no SYNC was received')
    rig.compare(rig.car, rig.sensors)


SERIAL = openings, lent, cuts, frozen_bus, short_stall, stalls, resets
NETWORK = closed, silent_network, cuts, frozen_bus, stalls
