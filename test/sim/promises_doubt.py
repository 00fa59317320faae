"""What is promised of motions by rows, and of doubts: where a link begins anew."""
import logging
import re
from typing import Dict, Iterator, List, Tuple

from evidence import Evidence, Interval, longer, merged, overlaps
from promises import (CALIBRATION, DRIVE, ECHO, FRESH, FUNCTION, HALT, HEARTBEAT, SLACK,
                      SYNC, Verdicts, is_zero, told)
from promises_car import asks_for_zero, repeated, times_out

_LINES = 10.0       # s in which a line is not said again


def _drives(e: Evidence) -> bool:
    """Whether the board has a motion by a row, from the start."""
    return e.kind == 'arduino' and not e.story.announces


def _stalls(e: Evidence, loop: int = 0) -> Iterator[Interval]:
    """The stalls of a loop in which the port was open, and stayed so."""
    # Where it is suspended in a write, it has run at the end of the stall before.
    wrote = {chunk.time for chunk in e.story.device.bridge_wrote}
    for begin, end in longer(merged(e.stalls[loop], 5e-4), 0.55):
        if any(begin < each < end and any(abs(each - time) < 1e-6 for time in wrote)
               for _, each in e.stalls[loop]) or not longer(
                   [each for each in e.stalls[loop] if begin <= each[0] < end], 0.55):
            continue
        opened, closed = e.opening_of(begin)
        if opened < begin and end < closed:
            yield begin, end


def motions_begin_with_zero(e: Evidence) -> Verdicts:
    """All zeros precede the first heartbeat of an opening and after a stall; an announced motion's
    is sent once announced."""
    zeros = [frame for frame in e.of_type(e.wrote, DRIVE) if is_zero(frame)]
    beats = e.of_type(e.wrote, HEARTBEAT)
    begins = e.story.device.openings + [end for _, end in longer(e.stalls[-1], 0.55)]
    for begin in begins if _drives(e) else ():
        closed = e.opening_of(begin)[1]
        beat = next((each for each in beats if begin < each.begun and each.time <= closed), None)
        if beat and not overlaps(e.suspended, begin + SLACK, beat.time):
            yield 1, '' if any(begin <= each.time and each.first < beat.first
                               for each in zeros) else \
                f'no zero from {begin:.3f} to the heartbeat of {beat.time:.3f}'
    for used, names in e.story.robot.used if e.kind == 'arduino' else ():
        opened, closed = e.opening_of(used)
        excused = 'drive' not in names or not opened < used - 0.4 < used + 0.1 < closed \
            or overlaps(e.stalls[0] + e.stalls[-1] + e.events('blocked', 'unplugged'),
                        used - 0.4, used + 0.1, 0.6) or _calibrates(e, used)
        yield not excused, '' if excused or any(
            used <= each.time <= used + 0.05 for each in zeros) else \
            f'no zero of the row that is in use from {used:.3f} on'


def _calibrates(e: Evidence, time: float) -> bool:
    states = [on for at, on in e.story.robot.calibrating if at <= time + 0.1]
    return bool(states and states[-1])


def motions_stop(e: Evidence) -> Verdicts:
    """The zero of a motion is sent within speed_timeout + 50 ms of its last command, and repeated
    as SPEED 0."""
    yield from times_out(e, DRIVE)
    yield from repeated(e, DRIVE)


def motions_end_first(e: Evidence) -> Verdicts:
    """All zeros precede a calibration, a loan, a reset and the end."""
    drives = e.of_type(e.wrote, DRIVE)
    before = [(frame.time, 'calibration') for frame in e.of_type(e.wrote, CALIBRATION)]
    before += [(asked, name) for asked, _, name, task in e.story.tasks
               if task.answer and task.answer[0]]
    before += [(e.story.ended, 'end')] if e.story.ended else []
    for time, name in before:
        opened, closed = e.opening_of(time)
        limit = time + (0.2 if name in ('lend', 'end') else 0.0)
        last = [frame for frame in drives if opened <= frame.time <= min(limit, closed)][-1:]
        excused = not last or overlaps(
            e.stalls[0] + e.stalls[-1] + e.events('blocked', 'unplugged', 'cut'),
            time - 0.1, limit, 0.3)
        yield not excused, '' if excused or is_zero(last[0]) else \
            f'{last[0].data.hex()} of {last[0].time:.3f} stands at the {name} of {time:.3f}'


def motions_are_saturated(e: Evidence) -> Verdicts:
    """A motion beyond its limits is sent as the limit, one that is not finite as the zero."""
    for command in e.story.commands:
        if command.name == 'drive':
            yield 1, '' if command.refused != 'value' else \
                f'drive {command.value} of {command.time:.3f} was refused'


def zeros_need_not_be_fresh(e: Evidence) -> Verdicts:
    """A zero is accepted also just after a stall."""
    for command in e.story.commands:
        if command.value in (0, (0.0, 0.0)) and command.name != 'led':
            yield 1, '' if command.refused != 'stall' else \
                f'{command.name} 0 of {command.time:.3f} was refused as from a stall'


def a_port_closes_for_a_cause(e: Evidence) -> Verdicts:
    """A tty or pty is closed for its loss, a loan, a reset and the end alone; no port of the bus
    for a stall."""
    device = e.story.device
    causes = e.events('unplugged', 'cut') + [
        (asked, until + 0.4) for asked, until, _, _ in e.story.tasks]
    if device.kind == 'network':
        causes += e.events('blocked', 'silence', 'reset')
        if e.kind == 'bus':     # a move that was not heard
            causes += [(called.ended, called.ended) for called in e.story.calls
                       if called.ended and told(called) == 'not known' and not called.repeatable]
        else:
            return
    for time in device.closings:
        caused = time >= (e.story.ended or time) or overlaps(causes + [
            each for each in merged(e.stalls[0]) if overlaps(causes, *each)], time - 0.3, time, 0.3)
        yield 1, '' if caused else f'it was closed at {time:.3f}'


def a_stalled_network_is_opened_again(e: Evidence) -> Verdicts:
    """After a stall a network connection is opened again, but that of the bus."""
    if e.kind == 'bus' or e.story.device.kind != 'network':
        return
    for begin, end in _stalls(e):
        excused = e.opening_of(end)[1] < end or end + 0.3 > (e.story.ended or 0.0)
        yield not excused, '' if excused or any(
            begin < each <= end + 0.3 for each in e.story.device.closings) else \
            f'the stall until {end:.3f} left the connection as it was'


def a_stall_drops_the_output(e: Evidence) -> Verdicts:
    """After a stall a tty or pty is flushed, but that of the bus."""
    if e.kind == 'bus' or e.story.device.kind == 'network':
        return
    for begin, end in _stalls(e):
        excused = e.opening_of(end)[1] < end + 0.3 or overlaps(
            e.stalls[0], end + SLACK, end + 0.3) or _calibrates(e, end)
        yield not excused, '' if excused or any(
            begin < each <= end + 0.3 for each in e.story.device.flushes) else \
            f'what was written before the stall until {end:.3f} may wait'


def a_doubt_is_fenced(e: Evidence) -> Verdicts:
    """After a stall or restored settings an ECHO or SYNC returns before the next request but a
    stop."""
    if not e.story.parameters.get('echo'):
        return
    doubts = e.story.device.restorations + [end for _, end in _stalls(e)]
    for time in doubts:
        closed = e.opening_of(time)[1]
        first = next((frame for frame in e.wrote if frame.begun > time
                      and not (frame.type == FUNCTION and frame.number == HALT)), None)
        if first and first.time < closed and not overlaps(e.suspended, time, first.time):
            # One that was outstanding may return.
            fenced = first.type in (ECHO, SYNC) or any(
                time <= each.time <= first.time for each in e.of_type(e.readable, ECHO, SYNC))
            yield 1, '' if fenced else \
                f'type {first.type} {first.number} at {first.time:.3f}, in doubt at {time:.3f}'


def a_doubt_is_told(e: Evidence) -> Verdicts:
    """A stall, and settings that another program changed, are told by a line."""
    lines = [time for time, level, _ in e.story.robot.said if level >= logging.WARNING]
    doubts = list(_stalls(e)) + [
        (each, each) for each in e.story.device.restorations if not _calibrates(e, each)]
    for begin, end in doubts:
        excused = any(begin - _LINES < each < begin for each in lines) or \
            end + 1.3 > (e.story.ended or end)
        yield not excused, '' if excused or any(
            begin <= each <= end + 1.2 for each in lines) else f'no line about {begin:.3f}'


def the_log_is_sparing(e: Evidence) -> Verdicts:
    """The same line is not logged again within 10 s."""
    last: Dict[str, float] = {}
    for time, level, text in e.story.robot.said:
        words = re.sub(r'\(and .*|[0-9a-f]*\d[0-9a-f]*', '', text)
        if level >= logging.WARNING:
            yield 1, '' if time - last.get(words, -1e9) >= _LINES - SLACK else \
                f'again at {time:.3f}: {text}'
        last[words] = time


def rows_outlive_doubts(e: Evidence) -> Verdicts:
    """While the port stays open, announced rows stay in use."""
    seen: Tuple = ()        # the opening and the board of which the rows were in use
    for time, report in e.story.reports if e.story.announces and not (      # else it may refuse to
            e.kind == 'bus' and any(e.story.device.damage_sent)) else ():
        since, rows = [each for each in e.story.boards if each[0] <= time][-1]
        now = e.opening_of(time), since
        if report.get('announced') == ', '.join(rows):
            seen = now
        elif now == seen:
            yield 1, f'{report.get("announced")} at {time:.3f}, the board has {rows}'
        yield now == seen, ''


def an_unheard_move_is_a_doubt(e: Evidence) -> Verdicts:
    """When a move times out with nothing received, what may wait is dropped."""
    device = e.story.device
    reads = [chunk.time for chunk in device.bridge_read]
    for called in e.story.calls:
        if called.repeatable or told(called) != 'not known' or not called.ended:
            continue
        sent = [frame.time for frame in e.wrote
                if frame.content == called.request]
        timeout = called.longest / 3
        if len(sent) != 1 or called.ended < sent[0] + timeout - SLACK or any(
                sent[0] <= each <= called.ended for each in reads) \
                or e.opening_of(sent[0])[1] < called.ended:
            continue
        halted = any(each.name == 'halt' and sent[0] <= each.time <= called.ended
                     for each in e.story.calls) or e.story.stopped_at
        dropped = device.flushes if device.kind != 'network' else device.closings
        yield not halted, '' if halted or any(
            called.ended - SLACK <= each <= called.ended + 0.3 for each in dropped) else \
            f'{called.name} of {called.time:.3f} timed out at {called.ended:.3f}, nothing dropped'


def a_silent_pty_takes_no_command(e: Evidence) -> Verdicts:
    """While a pty is silent after its board talked, commands are refused."""
    device = e.story.device
    if device.kind != 'pty':
        return
    limit = e.story.parameters['network_silence']
    reads = [chunk.time for chunk in device.bridge_read]
    for command in e.story.commands:
        now = command.time
        opened, closed = e.opening_of(now)
        heard = max([opened, *(each for each in reads if each <= now)])
        if opened > now or heard + limit + 0.2 > now or asks_for_zero(command) \
                or not any(each < heard + 1e-6 for each in reads):
            continue
        # A board that calibrates is silent; the link looks again within 0.1 s.
        excused = closed < now + SLACK or overlaps(e.stalls[0] + e.calibrations, heard, now, 0.2)
        yield not excused, '' if excused or command.refused else \
            f'{command.name} of {now:.3f} was accepted, silent since {heard:.3f}'


def standing_output_takes_no_command(e: Evidence) -> Verdicts:
    """While nothing leaves a tty, commands are refused."""
    if e.story.device.kind != 'tty':
        return
    stands = merged(e.events('blocked'), 0.0)
    for command in e.story.commands:
        for begin, end in stands:
            begin = max(begin, e.opening_of(command.time)[0])
            excused = overlaps(e.stalls[0] + e.stalls[-1], begin, command.time, FRESH)
            if begin + 0.6 < command.time < end - SLACK and command.value != 0:
                yield not excused, '' if excused or command.refused else \
                    f'{command.name} of {command.time:.3f}, blocked from {begin:.3f} on'


def short_stalls_lose_nothing(e: Evidence) -> Verdicts:
    """A stall of up to 0.4 s loses nothing."""
    counted = e.story.counted
    stalls = longer(merged(e.stalls[0] + e.stalls[-1], 0.11), 0.38)
    for (last, before, *_), (time, report, *_) in zip(counted, counted[1:]):
        if not overlaps(stalls, last, time, 0.7) and not any(
                last <= each <= time for each in e.story.device.flushes):
            more = report['stale'] - before['stale']
            yield 1, '' if not more else f'{more} bytes are stale at {time:.3f}'
    for command in e.story.commands:
        if not overlaps(stalls, command.time, command.time, FRESH + 0.1):
            yield 1, '' if command.refused != 'stall' else \
                f'{command.name} of {command.time:.3f} was refused as from a stall'


def standing_output_is_dropped(e: Evidence) -> Verdicts:
    """If nothing has left a tty for 0.3 s, what waits is dropped."""
    device = e.story.device
    for begin, end in e.events('blocked') if device.kind == 'tty' else ():
        waits = next((chunk.time for chunk in device.bridge_wrote if begin < chunk.time < end),
                     float('inf'))
        limit = waits + 0.6
        excused = limit > end or e.opening_of(begin)[1] < limit or overlaps(
            e.stalls[0] + e.stalls[-1], waits, limit, 0.1)
        yield not excused, '' if excused or any(
            waits <= each <= limit for each in device.flushes + device.closings) else \
            f'what waits since {waits:.3f} stands until {end:.3f}'


def a_silent_pty_is_doubted(e: Evidence) -> Verdicts:
    """A pty that is silent for network_silence after its board talked is flushed, once."""
    device = e.story.device
    if e.kind == 'bus' or device.kind != 'pty':
        return
    limit = e.story.parameters['network_silence']
    reads: List[float] = [chunk.time for chunk in device.bridge_read]
    for last, following in zip(reads, [*reads[1:], float('inf')]):
        due = last + limit
        end = min(following, e.opening_of(last)[1])
        excused = end < due + 0.3 or overlaps(
            e.stalls[0], last, due + 0.3, 0.2) or any(
            time < due + 0.3 for time, _ in e.story.robot.calibrating)
        # Another doubt begins the link anew, too: that of output that stands, or a stall.
        others = e.events('blocked') + [(end, end) for _, end in e.stalls[0] + e.stalls[-1]]
        excused |= overlaps(others, due, due + 0.3, 0.5) or any(
            last <= each <= due + 0.3 for each in device.restorations)
        flushes = [each for each in device.flushes if due - SLACK <= each < end - SLACK
                   and each not in device.restorations and not overlaps(others, each, each, 0.5)]
        if following > due:
            yield not excused, '' if excused or len(flushes) == 1 and flushes[0] <= due + 0.3 else \
                f'silent from {last:.3f} to {end:.3f}, flushed at {flushes}'
