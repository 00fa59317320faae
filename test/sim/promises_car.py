"""What is promised of the car: its motor, its commands, its calibration."""
import struct
from bisect import bisect_left
from math import isfinite
from typing import Dict, List, Optional

from evidence import At, Evidence, longer, merged, overlaps
from promises import (ANNOUNCEMENT, CALIBRATION, DRIVE, FRESH, FUNCTION, GRIPPER, HEARTBEAT, IMU,
                      LED, MOVES, SETTING, SLACK, SPEED, STALL, STEERING, TIMEOUT, Verdicts,
                      is_zero, speed_of, speeds)
from promises_data import implausible
from scenario import Command


def heartbeats_in_time(e: Evidence) -> Verdicts:
    """No gap of 30 ms between heartbeats while the port is open and the bridge runs."""
    beats = [frame.time for frame in e.of_type(e.wrote, HEARTBEAT)]
    resets = [(asked, asked + 0.2) for asked, _, name, task in e.story.tasks if name == 'reset']
    for begin, end in e.openings:
        times = [begin, *(each for each in beats if begin <= each <= end)]
        for last, beat in zip(times, times[1:]):
            excused = overlaps(e.stalls[1] + resets, last, beat, SLACK)
            yield not excused, '' if excused or beat - last < 0.03 else \
                f'no heartbeat from {last:.3f} to {beat:.3f}'
        if end - times[-1] >= 0.05 and not overlaps(
                e.stalls[1] + e.events('blocked'), times[-1], end, 0.1):
            yield 1, f'no heartbeat from {times[-1]:.3f} until it closed at {end:.3f}'


def speed_0_first(e: Evidence) -> Verdicts:
    """After an opening SPEED 0 is sent first, but for other zeros."""
    for begin, end in e.openings:
        first = _first_but_zeros([frame for frame in e.wrote if begin <= frame.time <= end])
        if first:
            yield 1, '' if is_zero(first) else \
                f'the first packet at {first.time:.3f} has type {first.type}'


def _first_but_zeros(frames: List[At]) -> Optional[At]:
    """SPEED 0 if nothing is before it but zeros of other motions; else the first of the others."""
    return next((frame for frame in frames if frame.type == SPEED or not is_zero(frame)), None)


def speeds_are_commanded(e: Evidence) -> Verdicts:
    """Every SPEED but 0 was commanded just then, limited to ±1000, and is sent once."""
    return _commanded(e, 'speed', SPEED)


def motions_are_commanded(e: Evidence) -> Verdicts:
    """Every motion of a row was commanded just then, is sent once, and keeps its limits."""
    return _commanded(e, 'drive', DRIVE)


def _commanded(e: Evidence, name: str, type_: int) -> Verdicts:
    accepted: Dict[bytes, List[float]] = {}
    for command in e.story.commands:
        if command.name == name and not command.refused:
            accepted.setdefault(_wire_value(name, command.value), []).append(command.time)
    for frame in e.of_type(e.wrote, type_):
        if not is_zero(frame):
            times = accepted.get(frame.data, [])
            at = next((time for time in times if time <= frame.time <= time + SLACK
                       or time <= frame.time and overlaps(e.suspended, time, frame.time)), None)
            yield 1, '' if at is not None else \
                f'{name} {frame.data.hex()} at {frame.time:.3f}, commanded at {times}'
            if at is not None:
                times.remove(at)


def no_old_speed_arrives(e: Evidence) -> Verdicts:
    """No motion but a zero reaches the board over 0.7 s after its command."""
    times = {(_TYPES[command.name], _wire_value(command.name, command.value)): command.time
             for command in e.story.commands if command.name in ('speed', 'drive')
             and not command.refused and not _is_saturated(command)}
    if any(e.story.device.damage_sent):
        return      # a damaged one may be another one
    blocked, kind = e.events('blocked'), e.story.device.kind
    for frame in e.of_type(e.got, SPEED, DRIVE):
        sent = times.get((frame.type, frame.data))
        if sent is None or is_zero(frame):
            continue
        # What a pty or a network hides cannot be taken back. A thread that does not run drops
        # nothing, and the board gets no heartbeats from it.
        excused = overlaps(blocked, sent, frame.time, 0.1) and (
            kind != 'tty' or overlaps(e.stalls[1], sent, frame.time))
        yield not excused, '' if excused or frame.time <= sent + 0.7 else \
            f'type {frame.type} {frame.data.hex()} of {sent:.3f} came at {frame.time:.3f}'


def speed_times_out(e: Evidence) -> Verdicts:
    """SPEED 0 is sent within speed_timeout + 50 ms of the last command."""
    return times_out(e, SPEED)


def times_out(e: Evidence, type_: int) -> Verdicts:
    """Whether the zero of this type follows its commands in time."""
    sent = e.of_type(e.wrote, type_)
    for frame, following in zip(sent, [*sent[1:], None]):
        if is_zero(frame):
            continue
        due = frame.time + TIMEOUT
        end = e.opening_of(frame.time)[1]
        excused = end < due + 0.05 or overlaps(e.stalls[1], frame.time, due + 0.05, 0.1) \
            or overlaps(e.events('blocked'), frame.time, due, 0.2)
        if not excused:
            at = following.time if following else float('inf')
            yield 1, '' if at <= due + 0.05 else \
                f'type {type_} {frame.data.hex()} of {frame.time:.3f} was followed at {at:.3f}'


def stops_are_repeated(e: Evidence) -> Verdicts:
    """A SPEED 0 that ends a motion is repeated every 50 ms for 1 s, or until another speed."""
    return repeated(e, SPEED)


def repeated(e: Evidence, type_: int) -> Verdicts:
    """Whether the zeros of this type are repeated."""
    sent = e.of_type(e.wrote, type_)
    moving = False
    for index, frame in enumerate(sent):
        if not is_zero(frame):
            moving = True
            continue
        begins, moving = moving, False
        if not begins or any(abs(end - frame.time) < 1e-3 for _, end in e.suspended):
            continue
        last = frame
        limit = min(e.opening_of(frame.time)[1], frame.time + 1.0)
        for following in sent[index + 1:]:
            if following.time > limit or not is_zero(following):
                break
            excused = overlaps(e.stalls[1] + [(asked, asked + 0.2) for asked, _, name, _ in
                                              e.story.tasks if name == 'reset'],
                               last.time, following.time, 0.05) \
                or overlaps(e.calibrations, frame.time, following.time)
            yield not excused, '' if excused or following.time - last.time <= 0.065 else \
                f'the zero of {last.time:.3f} was repeated at {following.time:.3f}'
            last = following
        else:
            following = None
        end = min(limit, following.time if following else limit)
        excused = overlaps(e.stalls[1] + e.events('blocked'), last.time, end, 0.1) \
            or overlaps(e.calibrations, frame.time, end)
        if not excused:
            yield 1, '' if end - last.time <= 0.07 else \
                f'the zero was repeated at {last.time:.3f} and then not until {end:.3f}'


def a_stall_ends_with_speed_0(e: Evidence) -> Verdicts:
    """After a stall of over 0.5 s SPEED 0 is sent first, but for other zeros."""
    for begin, end in longer(e.stalls[1], 0.55):
        opened, closed = e.opening_of(end)
        first = _first_but_zeros([each for each in e.wrote if end < each.time <= closed])
        last = [frame for frame in speeds(e) if opened <= frame.time <= end]
        moves = not last or speed_of(last[-1])
        if first and moves and not overlaps(e.suspended, end, first.time):
            yield 1, '' if is_zero(first) else \
                f'after the stall until {end:.3f} type {first.type} came first at {first.time:.3f}'


def nothing_moves_while_stopped(e: Evidence) -> Verdicts:
    """From ~stop to its release nothing that moves is sent."""
    for begin, end in e.events('stop'):
        for frame in e.wrote:
            if begin < frame.time < end:
                if e.kind == 'bus':
                    moves = frame.type == FUNCTION and frame.number in MOVES
                else:
                    moves = not is_zero(frame) and frame.type in (
                        SPEED, DRIVE, CALIBRATION, GRIPPER)
                yield 1, f'type {frame.type} at {frame.time:.3f}, stopped at {begin:.3f}' \
                    if moves else ''


def nothing_follows_a_loan(e: Evidence) -> Verdicts:
    """SPEED 0 is the last packet before a loan; nothing is sent while it lasts."""
    for asked, until, name, task in e.story.tasks:
        if name != 'lend' or not task.answer or not task.answer[0]:
            continue
        for opened, _ in e.openings:
            if asked + 0.3 < opened < until - 1e-6:
                yield 1, f'opened at {opened:.3f} while it is lent until {until:.3f}'
        closed = [each for each in e.story.device.closings if asked <= each <= until]
        if closed and e.kind == 'arduino' and not overlaps(
                e.events('unplugged', 'cut', 'blocked') + e.stalls[0], asked - 0.1, closed[0], 0.1):
            last = [frame for frame in e.wrote if frame.time <= closed[0]][-1]
            yield 1, '' if is_zero(last) else \
                f'type {last.type} was last before the loan at {closed[0]:.3f}'


def a_calibrating_board_is_left_alone(e: Evidence) -> Verdicts:
    """SPEED 0 precedes a calibration; until it is over only heartbeats are sent."""
    ends = [time for time, on in e.story.robot.calibrating if not on]
    for frame in e.of_type(e.wrote, CALIBRATION):
        moving = [each for each in speeds(e)
                  if each.time <= frame.time and each.first < frame.first]
        yield 1, '' if not moving or not speed_of(moving[-1]) else \
            f'a calibration at {frame.time:.3f} while it moves'
        end = min((each for each in ends if each >= frame.time), default=float('inf'))
        opened = e.opening_of(frame.time)
        for other in e.wrote:
            if frame.time < other.time < min(end, opened[1]):
                still = other.type == HEARTBEAT or is_zero(other)
                yield 1, '' if still else \
                    f'type {other.type} at {other.time:.3f} in a calibration'


def stale_commands_are_refused(e: Evidence) -> Verdicts:
    """Until 0.5 s after a stall only zeros are accepted."""
    for begin, end in longer(e.stalls[1], 0.55):
        for command in e.story.commands:
            if end < command.time < end + FRESH - SLACK and not asks_for_zero(command):
                yield 1, '' if command.refused else \
                    f'{command.name} {command.value} at {command.time:.3f}, a stall until {end:.3f}'


def values_are_of_this_board(e: Evidence) -> Verdicts:
    """Values of announced rows are published only once the board has announced them since the
    opening."""
    if e.kind == 'bus' or not e.story.announces:
        return
    chunks = [frame.time for frame in e.of_type(e.readable, ANNOUNCEMENT)]
    for time, name, _values, _stamp in e.story.robot.published:
        if name in ('force', 'push'):
            rows = [rows for since, rows in e.story.boards if since <= time][-1]
            opened = e.opening_of(time)[0]
            known = name in rows and any(opened <= each <= time for each in chunks)
            yield 1, '' if known else f'{name} at {time:.3f}, but the board has {rows}'


def announced_rows_wait(e: Evidence) -> Verdicts:
    """No announced command is sent before the board has announced it since the opening."""
    if not e.story.announces or e.kind != 'arduino':
        return
    for frame in e.of_type(e.wrote, GRIPPER, DRIVE):
        opened = e.opening_of(frame.time)[0]
        chunks = [each for each in e.of_type(e.readable, ANNOUNCEMENT)
                  if opened <= each.time <= frame.time]
        if opened < float('inf'):       # else it was lost at that moment
            yield 1, '' if chunks else \
                f'type {frame.type} at {frame.time:.3f}, opened at {opened:.3f}'


def _wire_value(name: str, value) -> bytes:
    """The data of a packet of this command."""
    if name == 'led':
        return value.encode() + b'\0'
    if name == 'drive':
        return struct.pack('<hh', *(min(max(round(each * 1000), -2000), 2000) for each in (
            value if isfinite(value[0]) else (0.0, 0.0))))
    return struct.pack('<h', min(max(value, -1000), 1000)) if name == 'speed' else \
        struct.pack('<H', value)


_TYPES = {'speed': SPEED, 'steering': STEERING, 'led': LED, 'gripper': GRIPPER, 'drive': DRIVE}


def asks_for_zero(command: Command) -> bool:
    return command.value in (0, (0.0, 0.0)) or command.name == 'drive' and not all(
        map(isfinite, command.value))


def _is_saturated(command: Command) -> bool:
    return abs(command.value) > 1000 if command.name == 'speed' else \
        not abs(command.value[0]) <= 2.0


def commands_arrive_unchanged(e: Evidence) -> Verdicts:
    """Commands arrive unchanged, once, in order, and none that was refused."""
    if any(e.story.device.damage_sent) or any(e.story.device.damage_received):
        return
    for name in 'steering', 'led', 'gripper':
        accepted = [_wire_value(name, command.value) for command in e.story.commands
                    if command.name == name and not command.refused]
        index = 0
        for frame in e.of_type(e.got, _TYPES[name]):
            found = frame.data in accepted[index:]
            yield 1, '' if found else f'{name} {frame.data.hex()} at {frame.time:.3f}'
            index = accepted.index(frame.data, index) + 1 if found else index


def commands_arrive(e: Evidence) -> Verdicts:
    """Every accepted command reaches the board of an open port."""
    if any(e.story.device.damage_sent) or any(e.story.device.damage_received):
        return
    got: Dict[int, Dict[bytes, List[float]]] = {}
    for frame in e.got:
        got.setdefault(frame.type, {}).setdefault(frame.data, []).append(frame.time)
    disturbed = e.stalls[1] + e.stalls[0] + e.events('blocked', 'altered', 'cut', 'unplugged') + [
        (asked, asked + 0.1) for asked, _, _, _ in e.story.tasks]
    for command in e.story.commands:
        if command.name not in _TYPES or command.refused or asks_for_zero(command):
            continue
        opened, closed = e.opening_of(command.time)
        excused = closed < command.time + 0.2 or overlaps(
            disturbed, command.time - 0.1, command.time + 0.2, 0.4) or overlaps(
            [(each, each) for each in e.story.device.flushes], command.time, command.time + 0.2)
        times = got.get(_TYPES[command.name], {}).get(_wire_value(command.name, command.value), [])
        yield not excused, '' if excused or any(
            command.time <= each <= command.time + 0.15 for each in times) else \
            f'{command.name} {command.value} of {command.time:.3f} did not arrive'


def refusals_are_true(e: Evidence) -> Verdicts:
    """A command is refused while the port is closed, and never without its cause."""
    device, story = e.story.device, e.story
    reads = [chunk.time for chunk in device.bridge_read]
    limit = story.parameters['network_silence']
    for command in story.commands:
        now, cause = command.time, command.refused
        opened, closed = e.opening_of(now)
        if opened == float('inf') and not overlaps(e.events('unplugged', 'cut'), now, now, 0.1) \
                and not overlaps([(each, each) for each in device.closings], now, now, 0.01):
            yield 1, '' if cause else f'{command.name} at {now:.3f} was accepted, it is closed'
            continue
        bad = command.name == 'led' and (
            len(command.value) > 30 or not command.value.isascii())
        may = {'': not bad, 'value': bad, 'stopped': overlaps(e.stops, now, now),
               'calibrating': overlaps(e.calibrations, now, now) or command.name == 'calibrate',
               'stall': overlaps(longer(merged(e.stalls[1] + e.stalls[0]), STALL), now, now,
                                 FRESH + 0.11),     # it may wait for its output to leave
               'silent': device.kind == 'pty' and not any(
                   now - limit + 0.2 < each <= now - 0.15 for each in reads),
               # A board that runs for long announces a chunk a second.
               'not announced': story.announces and (now < opened + 14.0 or overlaps(
                    e.events('silence', 'reset', 'noise', 'unplugged') + e.stalls[0],
                    now - 14.0, now) or any(device.damage_received)),
               'port': device.kind == 'network' and overlaps(e.stalls[0], now, now, 0.1)
               or overlaps([(end, end) for _, end in e.openings], now - 0.2, now, 0.2)
               or not opened < float('inf') or overlaps(
                   [(asked, asked + 0.2) for asked, _, _, _ in story.tasks], now, now)}
        yield 1, '' if may.get(cause, cause in ('busy', 'stopping')) else \
            f'{command.name} {command.value} at {now:.3f} was refused: {cause!r}'
        if cause and command.name in ('steering', 'led', 'gripper') and not bad:
            data = _wire_value(command.name, command.value)
            sent = [frame for frame in e.of_type(e.wrote, _TYPES[command.name])
                    if frame.data == data]
            yield 1, '' if not sent else \
                f'{command.name} of {now:.3f} was refused, and sent at {sent[0].time:.3f}'


def calibrations_end(e: Evidence) -> Verdicts:
    """A calibration ends with IMU data after 2 s of silence, after 5 s of data, its timeout or a
    reset; not later."""
    limit = e.story.parameters['calibration_timeout']
    imu = [frame for frame in e.of_type(e.read, IMU)
           if len(frame.data) == 22 and not implausible(frame)]
    resets = [asked for asked, _, name, _ in e.story.tasks if name == 'reset']
    stalls = longer(merged(e.stalls[0]), STALL)
    for start, end in e.calibrations:
        is_over = end < float('inf')
        last = end if is_over else e.story.ended or e.story.world.time
        yield 1, '' if last <= start + limit + 0.2 or overlaps(
            e.stalls[0], start + limit, last, 0.2) else \
            f'the calibration of {start:.3f} goes on at {last:.3f}'
        if not is_over:
            continue
        # The bridge may be suspended in the write of the calibration.
        begun = min([start, *(low for low, high in e.suspended if abs(high - start) < 1e-6)])
        times = [begun, *sorted({frame.time for frame in imu if start < frame.time <= end})]
        # Of those that may have been dropped after a stall either may count.
        sure = [each for each in times[:-1] if not overlaps(stalls, each, each, FRESH + 0.1)]
        stalled = sum(min(high, end) - low for low, high in longer(e.stalls[0], 0.5)
                      if sure and sure[-1] <= low < end - 0.5)
        silent = len(times) > 1 and times[-1] > end - 0.01 and (
            not sure or times[-1] - sure[-1] - stalled >= 2.0 - SLACK)
        right = silent or end >= start + 5.0 - SLACK and times[-1] > end - 0.01 \
            or end >= start + limit - SLACK or any(end - 1.0 < each <= end for each in resets)
        yield 1, '' if right else \
            f'the calibration of {start:.3f} was over at {end:.3f}: {times[-3:]}'


def calibrations_end_in_time(e: Evidence) -> Verdicts:
    """The first IMU data after 2 s of silence, or 5 s of data, ends a calibration."""
    imu = [frame.time for frame in e.of_type(e.read, IMU)
           if len(frame.data) == 22 and not implausible(frame)]
    for start, end in e.calibrations:
        closed = e.opening_of(start)[1]
        last = start
        for time in (each for each in imu if each > start):
            if time > end + SLACK or time > closed - SLACK or overlaps(
                    e.stalls[0] + e.events('altered', 'noise') + [
                        (each, each) for each in e.story.device.flushes], start, time, 0.1):
                break
            over = time - last >= 2.0 + SLACK or time - start >= 5.0 + SLACK
            yield over, '' if not over or end <= time + SLACK else \
                f'the calibration of {start:.3f} goes on at {time:.3f}, the data before {last:.3f}'
            last = time


def silences_were_observed(e: Evidence) -> Verdicts:
    """A silence that a stall or a closed port has made ends no calibration."""
    boards = [fields['on'] for time, event, fields in e.story.far.notes if event == 'calibrate']
    begun = [time for time, event, fields in e.story.far.notes
             if event == 'calibrate' and fields['on']]
    over = [time for time, event, fields in e.story.far.notes
            if event == 'calibrate' and not fields['on']]
    limit = e.story.parameters['calibration_timeout']
    resets = [begin for begin, _ in e.events('reset', 'unplugged')]
    resets += [task[0] for task in e.story.tasks]
    silences = [begin for begin, _ in e.events('silence', 'blocked')]
    for asked, end in e.calibrations if boards else ():
        start = max((each for each in begun if each <= end), default=None)
        if start is None or end >= asked + limit - SLACK or any(
                start - 1.0 <= each <= end for each in resets + silences):
            continue
        done = min((each for each in over if each >= start), default=float('inf'))
        yield 1, '' if done <= end else f'over at {end:.3f}, the board calibrates since {start:.3f}'


def heartbeats_are_regular(e: Evidence) -> Verdicts:
    """There are 100 heartbeats a second, and never over 13 in 0.1 s."""
    beats = [frame.time for frame in e.of_type(e.wrote, HEARTBEAT)]
    # The link's thread closes a port that is lent, or a connection that is given up.
    lent = [stall for stall in e.stalls[0] if e.story.device.kind == 'network' or overlaps(
        [(asked, asked) for asked, _, _, _ in e.story.tasks], *stall)]
    for index, beat in enumerate(beats[:-13]):
        if e.opening_of(beat) == e.opening_of(beats[index + 13]):
            yield 1, '' if beats[index + 13] > beat + 0.1 else f'13 heartbeats from {beat:.3f} on'
    for opened, closed in e.openings:
        begin = opened
        while begin + 1.0 < closed:
            if not overlaps(e.stalls[1] + lent + e.events('blocked'), begin, begin + 1.0, 0.2):
                count = bisect_left(beats, begin + 1.0) - bisect_left(beats, begin)
                yield 1, '' if 98 <= count <= 110 else f'{count} heartbeats from {begin:.3f}'
            begin += 1.0


def the_end_is_speed_0(e: Evidence) -> Verdicts:
    """When the bridge ends, SPEED 0 is the last packet."""
    ended = e.story.ended
    if ended is None or not e.wrote or not e.openings:
        return
    opened, closed = e.openings[-1]
    excused = not opened < ended <= closed + 1e-6 or overlaps(
        e.stalls[1] + e.events('blocked', 'unplugged', 'cut'), ended - 0.1, ended, 0.3)
    last = e.wrote[-1]
    yield not excused, '' if excused or is_zero(last) else \
        f'type {last.type} was the last at {last.time:.3f}, the end is at {ended:.3f}'


def settings_wait_for_their_board(e: Evidence) -> Verdicts:
    """No announced setting is sent before the board has announced it since the opening."""
    if e.kind == 'bus' or not e.story.announces:
        return
    for frame in e.of_type(e.wrote, SETTING):
        opened = e.opening_of(frame.time)[0]
        rows = [rows for since, rows in e.story.boards if since <= frame.time][-1]
        chunks = [each for each in e.of_type(e.readable, ANNOUNCEMENT)
                  if opened <= each.time <= frame.time]
        # The board may have been exchanged while the bridge was suspended inside the write.
        excused = any(end == frame.time for _, end in e.suspended)
        yield not excused, '' if excused or chunks and 'kp' in rows else \
            f'a setting at {frame.time:.3f}, opened at {opened:.3f}: the board has {rows}'


def no_stop_without_a_cause(e: Evidence) -> Verdicts:
    """No SPEED 0 is sent sooner than speed_timeout after a speed, unless asked for."""
    story, device = e.story, e.story.device
    asked = [command.time for command in story.commands
             if command.name == 'calibrate' or command.name == 'speed' and command.value == 0]
    asked += story.stopped_at + device.flushes + device.openings + [
        time for time, _, _, _ in story.tasks] + [story.ended or float('inf')]
    caused = [(time, time) for time in asked] + e.stalls[1] + e.stalls[0] + e.events(
        'altered', 'blocked')
    sent = speeds(e)
    for frame, following in zip(sent, sent[1:]):
        if speed_of(frame) and not speed_of(following):
            excused = following.time >= frame.time + TIMEOUT - SLACK or overlaps(
                caused, frame.time - SLACK, following.time + SLACK, 0.3)
            yield 1, '' if excused else \
                f'SPEED 0 at {following.time:.3f}, {speed_of(frame)} at {frame.time:.3f}'


def dropped_output_ends_with_speed_0(e: Evidence) -> Verdicts:
    """After dropped output or restored settings of a tty SPEED 0 is sent first, unless the board
    calibrates."""
    for time in e.story.device.flushes + e.story.device.restorations:
        if overlaps(e.calibrations, time, time):
            continue
        first = _first_but_zeros([frame for frame in e.wrote if frame.begun > time])
        excused = first is None or first.time > e.opening_of(time)[1] or overlaps(
            e.suspended, time, first.time) or any(
            frame.begun == time and frame.type == SPEED and not speed_of(frame)
            for frame in e.wrote)
        yield not excused, '' if excused or is_zero(first) else \
            f'type {first.type} at {first.time:.3f} was the first after {time:.3f}'
