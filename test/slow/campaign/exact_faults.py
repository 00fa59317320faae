"""What waits, or is sent, while a line or the bridge does not work; and what follows.

On serial lines and behind networks, for all links: ports that disappear, lines that take nothing,
stalls of the bridge, and resets of the boards.
"""
import contextlib
import itertools
import math
import time
from typing import Callable, Dict, Iterable, NamedTuple, Tuple

import by_definition as codec
from .boards import HALT, OK, Reaction, Request, reply_frame
from .exact_bus import QUEUE_TIME, SERVICES, Calls, no_sync, reconnect
from .exact_car import SILENT, TYPES, Drive, check_first, check_not_silent, check_repetitions
from .exact_data import REPORTED
from .rig import AFTER, MOTION_TIMEOUT, NOISE, STOP_FIRST, Rig
from .robot import COMMANDS, NOT_SENT

SYNC_FIRST = 'after a reconnect the first request is SYNC'
PORT_RETURNS = "data within 1.5 s of the port's return"
PORT_RETURN = 1.5        # s
_NO_OLD_DATA = 'no data from the time of a stall is published over a network'
_NETWORK_RETURN = 3.0    # s
_UNSEEN = 1.5            # s: no command that has waited longer unseen reaches the board
_SILENCE = 5.0           # s: mcu/network_silence
_RESUMES = 1.0           # s
_FIRST_LOAN = 2.0        # s
LONG_TIMEOUT = 2.5       # s, of a motion: a parameter of one bridge
_STALE = 'bytes that waited during a stall are dropped, counted as stale'
_LOGGED = r'arduino: the bridge stalled for .* s: (\d+) bytes'
# Errors that a reconnect must not cause: a board may be sending when its port is opened or closed.
_COUNTED = ('mcu', {'reconnects': 1, 'frames lost': 0}), ('arduino', {
    'framing errors': 0, 'length errors': 0, 'unknown type errors': 0})


def openings(rig: Rig) -> None:
    """All ports disappear, while the car stands or drives and a call is outstanding, and return:
    later, or at once as other devices."""
    returns, sync = rig.row(PORT_RETURNS), rig.row(SYNC_FIRST)
    exact = rig.row('the counters in /diagnostics are exact')
    calls, drive = Calls(rig), Drive(rig)
    for drives, at_once in rig.tries(*itertools.product((False, True), repeat=2)):
        made = [calls.start_unanswered()]
        old = [drive.command().number] if drives else []
        rig.car_line.write(b'\x05\x07\x01')        # an incomplete packet
        rig.sleep(0.02)
        for line in rig.lines.values():
            line.unplug()
        if not at_once:     # else within the speed timeout, and as other devices
            old += drive.publish(5)
            made.append(calls.start('lift'))
            calls.check(made[1], 'while unplugged', 'not sent', QUEUE_TIME)
            for link in rig.lines:
                rig.diagnosed(link, 2, 'closed: there is no such device')
            reports = rig.robot.published['mcu/status']
            count = len(reports)
            rig.row(REPORTED).wait(lambda: len(reports) > count, 'of a closed port', 10.0)
            rig.row(STOP_FIRST).check(not rig.robot.call('calibrate_imu').success
                                      and not rig.robot.published['~imu/calibrating'],
                                      'a closed port calibrates')
        since, count, connection = len(rig.car.packets), len(rig.bus.requests), rig.bus.connection
        rig.bus.react = None
        with contextlib.ExitStack() as stack:
            for link, wanted in () if at_once else _COUNTED:
                stack.enter_context(rig.counted(exact, link, wanted))
            began = time.monotonic()
            for line in rig.lines.values():
                line.plug(another_name=at_once)
            rig.wait_for_data('mcu/cliff', rig.sensors.cliff, returns)
            returned = time.monotonic()
            rig.wait(lambda: rig.car.beats and len(rig.bus.requests) > count, 'ports are opened')
            rig.car_line.write(codec.arduino_packet(200, b'abc'))     # the board may just start
        calls.check(made[0], 'unplugged', 'not known')
        first = rig.bus.requests[count]
        for link, at in ('mcu', returned), ('arduino', rig.car.first.t), ('bus', first.t):
            rig.in_time(returns, began, at, PORT_RETURN, link)
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
        gap = float(rig.next_report('arduino')[2]['heartbeat max gap [ms]'])
        exact.check(at_once or gap < 1000, f'heartbeat max gap: {gap} ms')
    rig.diagnosed('arduino', 0, 'open')


def lent(rig: Rig) -> None:
    """All ports are lent while the car drives: until they are given back, or the loan ends."""
    stop_last = rig.row("SPEED 0 is the last packet before the car's port is lent")
    required = rig.row('a lent port is left alone, and opened again when the loan ends')
    calls, drive = Calls(rig), Drive(rig)
    released: Dict[str, Tuple[float, float]] = {}     # when the last call began and ended

    def release(seconds: float) -> float:
        began = time.monotonic()
        for link in rig.lines:
            outcome = rig.robot.call(f'{link}/release', 'campaign', seconds)
            released[link] = outcome.began, outcome.ended
            required.check(outcome.success, f'{link}/release: {outcome}')
        return began + seconds

    for seconds, is_given_back in rig.tries((9.0, True), (60.0, False)):
        lift = calls.start_unanswered()
        required.check(not rig.robot.call('bus/release', 'campaign', 1.0).success,
                       'lent while the lift moves')
        lift.result()
        for by, loan in (' ', 1.0), ('campaign', -1.0), ('campaign', math.nan):
            required.check(not rig.robot.call('mcu/release', by, loan).success,
                           f'lent to {by!r} for {loan} s')
        required.check(not rig.robot.call('arduino/reset').success, 'a pty has no lines')
        silences = len(rig.logs.find(SILENT))
        if is_given_back:           # the other time it stands
            drive.command()
        release(_FIRST_LOAN)        # and renewed
        renewed_at = time.monotonic()
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
                       and not rig.robot.call('arduino/release', 'another', 0.0).success
                       and not rig.robot.call('arduino/reset').success, 'lent or reset, too')
        required.check(not rig.car.first and len(rig.bus.requests) == count,
                       f'{rig.car.first} or {rig.bus.requests[count:]} was sent')
        if is_given_back:
            rig.sleep(renewed_at + _FIRST_LOAN - time.monotonic())
            rig.diagnosed('arduino', 1, 'lent to campaign')
            free_at = release(0.0)
        else:               # the program that borrowed the car's port ends late
            holder = rig.child('holder', ['sh', '-c', f'exec sleep 60 < {rig.car_line.port}'])
            rig.sleep(ends_at + PORT_RETURN - time.monotonic())
            required.check(not rig.car.first, 'opened while another program has it open')
            rig.end(holder)
            free_at = time.monotonic()
        required.wait(lambda: rig.car.beats and len(rig.bus.requests) > count, 'they are opened')
        rig.in_time(required, free_at, check_first(rig).t, PORT_RETURN, f'{seconds:g} s', -0.5)
        began, ended = (at + (0.0 if is_given_back else 10.0) for at in released['bus'])
        rig.in_time(required, ended, rig.bus.requests[count].t, PORT_RETURN, f'{seconds:g} s',
                    began - ended - 0.5)
        rig.row(SYNC_FIRST).check(rig.bus.requests[count].cmd1 == codec.SYNC, 'not SYNC')
        rig.wait_for_data('mcu/cliff', rig.sensors.cliff, rig.row(PORT_RETURNS))
        for topic in '~counter', 'mcu/adc_status':
            required.check(not rig.robot.values(topic), f'{topic} was published from before')
        rig.wait_beats(AFTER)
        drive.check_not_sent(old, 'commanded while the port was lent', since)
        drive.command_until_accepted()
        check_not_silent(rig, silences)


def closed(rig: Rig) -> None:
    """The other side of a network closes the connection: with a reset, or without one."""
    returns = rig.row(PORT_RETURNS)
    published = rig.robot.published['mcu/cliff']
    for link, board, works in (
            ('arduino', rig.car, lambda: rig.car.beats),
            ('bus', rig.bus, lambda: rig.bus.connection_requests),
            ('mcu', rig.sensors, lambda: rig.sensors.cliff() or len(published) > count)):
        for close in rig.lines[link].unplug, rig.lines[link].shut_down:
            connection, count, began = board.connection, len(published), time.monotonic()
            rig.car.forget_beat()
            close()
            returns.wait(lambda: board.connection > connection and board.line.plugged and works(),
                         link)
            rig.in_time(returns, began, time.monotonic(), PORT_RETURN, f'{link} {close.__name__}')
    Drive(rig).command_until_accepted()


def silent_network(rig: Rig) -> None:
    """The sensor board's network is cut without a word."""
    required = rig.row('a network port without a byte for network_silence is opened again')
    rig.sensors.measure()
    began, connection = time.monotonic(), rig.sensors.connection + 1
    rig.mcu_line.lose_connection()
    required.wait(lambda: rig.mcu_line.plugged, 'it is opened again')
    rig.in_time(required, began, time.monotonic(), _SILENCE + PORT_RETURN, 'mcu', _SILENCE - 0.1)
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
_FROZEN_LONG = _FROZEN._replace(seconds=2.2)    # after the end of the repetitions of SPEED 0
_HANGS = Cut(2.5, _hang, _UNSEEN_BY, _UNSEEN)
SERIAL_CUTS = _FROZEN, _FROZEN_LONG, _HANGS, _HANGS
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
        if cut.begin is not _freeze or now < began + cut.seconds * 0.6:
            published[drive.publish(1, cut.names)[0]] = now
        else:
            rig.sleep(0.05)
        if cut.begin is _freeze:
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
    if cut.begin is _freeze:
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
    for is_stopped in rig.tries(False, True):
        def probe(request: Request) -> Reaction:
            if not rig.is_network:
                rig.bus_line.hang()     # before the reply, which lets the bridge send the move
            rig.bus.write(rig.bus.ok_reply(request))
            if rig.is_network:
                rig.bus_line.hang()     # nothing passes any more, not even the reply
            return Reaction()
        rig.bus.probe = probe
        call = calls.start('lift')
        if is_stopped:
            rig.wait(lambda: rig.bus_line.frozen, 'the fence')
            rig.sleep(0.1)              # the lift is behind it
            rig.robot.start_call('halt')
        call.result()
        rig.bus.probe = None
        rig.sleep(1.0 if is_stopped else 0.5)
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
        values = Drive(rig).publish(3, pause=0.0)
        for number in range(1, 5):
            rig.measure()
            rig.sleep(held_at + 0.05 * number - time.monotonic())
        beats, began = rig.car.all_beats, time.monotonic()
    rig.diagnosed('arduino', 1, 'heartbeat gap', held_at)
    gap = float(rig.next_report('arduino')[2]['heartbeat max gap [ms]'])
    rig.row('the counters in /diagnostics are exact').check(gap >= 200, f'max gap {gap} ms')
    rig.wait_beats(AFTER)
    beats, most = rig.car.all_beats - beats, 100 * (time.monotonic() - began) + 10
    rig.row('heartbeats: 100 a second').check(beats < most, f'{beats} behind a stall, not {most}')
    rig.car.talks = True
    rig.compare(rig.car, rig.sensors)
    rig.row('a stall of 0.2 s loses nothing').check(
        rig.car.packet(codec.SPEED, values[-1]), 'the newest speed is lost')
    for name in 'speed', 'steering':
        sent = [each for each in rig.car.commands(TYPES[name]) if each > 0]
        rig.row('of a burst of commands each arrives at most once, in order, and the last').check(
            sent == values[-1:], f'{name}: {sent} arrived, the newest is {values[-1]}')
    rig.diagnosed('arduino', 0, 'open')


def stalls(rig: Rig) -> None:
    """SIGSTOP of the bridge, while commands are published, services called and data sent. A reply
    and data wait; over a network they are dropped with the connection."""
    for seconds in rig.tries(*((0.7, 1.5) if rig.is_network else (0.4, 0.6))):
        _count_stale(rig, seconds)


def stalls_logged(rig: Rig) -> None:
    """Another one, long enough after it to be logged, too."""
    rig.sleep(10.0)
    rig.settle()
    size = _count_stale(rig, 1.2)
    rig.row(_STALE).wait(lambda: rig.logs.find(_LOGGED)[-1:] == [str(size)],
                         f'{size} dropped bytes are logged', 5.0)


def _count_stale(rig: Rig, seconds: float) -> int:
    """Let the bridge stall; return how many bytes of the car it had to drop."""
    counted = rig.row(_STALE)
    stale: Dict[str, Dict[str, int]] = {
        link: {} if rig.is_network else {'stale': 0} for link in ('arduino', 'mcu')}
    with rig.counted(counted, 'arduino', stale['arduino']), \
            rig.counted(counted, 'mcu', stale['mcu']):
        _stall(rig, seconds, stale)
    Drive(rig).command_until_accepted()
    return stale['arduino'].get('stale', 0)


def stalls_behind(rig: Rig) -> None:
    """What comes behind a stall of seconds in which nothing was asked for."""
    with rig.suspended():
        rig.sleep(2.5)
    began = time.monotonic()
    rig.sleep(1.2)
    stops = [each.is_stop for each in rig.car.packets]
    rig.row('a SPEED 0 that ends a motion is repeated every 50 ms for 1 s').check(
        all(stops) and len(stops) > 15, f'{len(stops)} times behind a stall: {rig.car.packets}')
    reports = [at for at in rig.robot.report_times if began < at < began + 0.5]
    rig.row('level and words in /diagnostics are true').check(
        len(reports) <= 1, f'{len(reports)} at once behind a stall')
    rig.row('no late or doubled reply is used for another request').check(
        [each.cmd1 for each in rig.bus.requests] == [codec.ECHO],
        f'behind a stall: {rig.bus.requests}')


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
    resumed_at, rig.bus.react = time.monotonic(), None
    made.append(calls.start('lift'))
    rig.sleep(0.25)
    if not rig.is_network:      # what is received within 0.5 s of a stall may have waited, too
        rig.measure()
    for board in car, rig.sensors:
        wanted = stale[board.line.name]
        wanted.update({key: len(b''.join(board.written)) for key in wanted})
    made.append(calls.start('lift'))
    rig.wait_beats(0.5)         # until the bridge drops nothing any more
    _check_data_after_stall(rig, resumed_at)
    rig.wait_beats(AFTER)
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
    old_calls.check(f'status {NOT_SENT} ' in outcome.message and not sent,
                    f'calibrate_imu: {outcome}')
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
    required = rig.row(_NO_OLD_DATA if rig.is_network else _STALE)
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
    since = len(rig.bus.requests)
    calls.check(call, 'reset', 'not known')
    rig.sleep(0.9)
    rig.sensors.seq = 0
    for _ in range(5):
        rig.measure()
    rig.car.talks = True
    calls.call('lift', 'after a reset', 'done')
    first = [each.cmd1 for each in rig.bus.requests[since:]][:2]
    required.check(rig.bus.in_step and first == [codec.ECHO, codec.SYNC], f'{first} were received')
    rig.compare(rig.car, rig.sensors)


def queued(rig: Rig) -> None:
    """Calls wait for their turn when the bridge is suspended."""
    required = rig.row('a call from the time of a stall, or 0.5 s after it, is not sent')
    calls = Calls(rig)
    for service in rig.tries('gimbal', 'bus/request', 'press'):
        rig.bus.react = lambda request: Reaction([(1.5, OK)], True)
        lift = calls.start('lift')
        rig.wait(lambda: rig.bus.executed[lift.key], 'it arrives')
        waiting = calls.start(service)
        rig.sleep(0.1)
        with rig.suspended():
            rig.sleep(0.4)
        calls.check(lift, 'over a stall', 'done', LONG_TIMEOUT)
        outcome = waiting.result()
        required.check(outcome.status == NOT_SENT and not rig.bus.executed[waiting.key],
                       f'{service}, from before a stall: {outcome}')
    rig.settle()
    lift = calls.start_unanswered()
    rig.sleep(1.2)
    rig.bus.react = None
    calls.call('bus/request', 'behind one that times out', 'done', LONG_TIMEOUT)
    calls.check(lift, 'without a reply', 'not known', LONG_TIMEOUT)
    rig.settle()
    rig.bus.react = lambda request: Reaction([(0.1, NOISE), (1.5, OK)], True) \
        if request.cmd2 == codec.LIFT else None
    lift = calls.start('lift')
    rig.wait(lambda: rig.bus.executed[lift.key], 'it arrives')
    rig.sleep(0.3)
    calls.call('bus/request', 'behind noise in a motion', 'done', LONG_TIMEOUT)
    calls.check(lift, 'with noise', 'done', LONG_TIMEOUT)
    rig.settle()
    reconnect(rig, no_sync)
    rig.wait(lambda: len(rig.bus.requests) > 2, 'SYNC is repeated')
    calls.call('lift', 'without SYNC', 'not sent', 0.0)


def no_limits(rig: Rig) -> None:
    """Limits of 0: no silence holds commands back, and no time stops the car."""
    not_early = rig.row('no SPEED 0 before speed_timeout, unless it was commanded')
    drive, rig.car.talks = Drive(rig), False
    rig.sleep(1.5)
    packet = drive.command()
    rig.sleep(1.0)
    not_early.check(not rig.car.stop_after(packet), 'SPEED 0 with a speed_timeout of 0')
    rig.robot.command('speed', 0)
    not_early.wait(lambda: rig.car.stop_after(packet), 'SPEED 0')
    rig.car.talks = True


NO_LIMITS = {'arduino/network_silence': 0.0, 'arduino/speed_timeout': 0.0}
SERIAL = (openings, cuts, frozen_bus, short_stall, stalls, stalls_logged, stalls_behind,
          resets)
LONG = lent,
NETWORK = closed, silent_network, cuts, frozen_bus, stalls
