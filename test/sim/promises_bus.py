"""What is promised of calls on the bus."""
import struct
from typing import Dict, List, Tuple

from by_definition import reply_at
from evidence import At, Evidence, decoded, longer, overlaps
from promises import (ECHO, ENVIRONMENT, FRESH, FUNCTION, GIMBAL, HALT, INVALID, LEVEL, LIFT, MOVES,
                      OK, PRESS, SLACK, SYNC, Verdicts, executed_by, told)
from scenario import Called


def calls_are_told_the_truth(e: Evidence) -> Verdicts:
    """Done: executed exactly once. Refused: not at all. Not known: at most once."""
    executed, refused = executed_by(e), {frame.time for frame in e.of_type(e.sent, INVALID)}
    sent_by = {}
    for called in e.story.calls:
        sent_by.setdefault(called.request, []).append(called)
    for request, group in sent_by.items():
        if len(group) > 1 or group[0].repeatable:
            continue
        # The line may double a request; the bridge must not. What is doubled comes at one time.
        came = {frame.time for frame in e.got if frame.content == request} - refused
        called, times = group[0], min(len(set(executed.get(request, ()))), max(len(came), 1))
        if _may_take_another_reply(e, called):
            continue
        right = {'done': times == 1, 'refused': times == 0, 'answered': times <= 1,
                 'not known': times <= 1, 'nothing': times <= 1}[told(called)]
        yield 1, '' if right else f'{called.name} {request} of {called.time:.3f} was executed ' \
            f'{times} times: {called.told}'


def _may_take_another_reply(e: Evidence, called: Called) -> bool:
    """Whether the second reply to a request that the line has doubled may pass for that to this
    call: a silence is no fence against a reply that comes later."""
    sent = [frame.content for frame in e.got
            if called.time - 5.0 < frame.time <= (called.ended or float('inf'))]
    return not e.story.parameters['echo'] and any(
        sent.count(request) > 1 for request in set(sent) if request[0] == FUNCTION)


def calls_return(e: Evidence) -> Verdicts:
    """A call returns within the timeouts of its tries and the wait for its turn."""
    for called in e.story.calls:
        limit = max(5.0, 0.8) + called.longest + 3 * 0.8 + 0.3
        if e.story.ended is None or called.time + limit > e.story.ended:
            continue
        waited = (called.ended or float('inf')) - called.time
        excused = overlaps(e.stalls[0], called.time, called.time + limit)
        yield not excused, '' if excused or waited <= limit else \
            f'{called.name} of {called.time:.3f} took {waited:.3f} s'


def a_sync_comes_first(e: Evidence) -> Verdicts:
    """After an opening only SYNC and stops are sent until SYNC is answered."""
    for begin, end in e.openings if e.kind == 'bus' else ():
        answered = min((frame.time for frame in e.of_type(e.readable, SYNC)
                        if begin <= frame.time <= end), default=end)
        for frame in e.wrote:
            if begin <= frame.time < min(answered, end):
                yield 1, '' if frame.type == SYNC or frame.number == HALT else \
                    f'type {frame.type} {frame.number} at {frame.time:.3f} before SYNC was answered'


def fences_precede_calls(e: Evidence) -> Verdicts:
    """An ECHO that has returned precedes every request that moves something."""
    if e.kind != 'bus' or not e.story.parameters['echo']:
        return
    echoes = e.of_type(e.readable, ECHO)
    before = None
    for frame in e.wrote:
        if frame.type == FUNCTION and frame.number in MOVES:
            fence = before is not None and before.type == ECHO and any(
                each.data == before.data and before.time <= each.time <= frame.time
                for each in echoes)
            yield 1, '' if fence else f'{frame.number} at {frame.time:.3f} has no fence'
        before = frame if frame.number != HALT else before


def stops_are_sent_at_once(e: Evidence) -> Verdicts:
    """A stop is sent within 50 ms, whatever is outstanding."""
    halts = [frame.time for frame in e.wrote if frame.type == FUNCTION and frame.number == HALT]
    for called in e.story.calls:
        if called.name != 'halt' or told(called) == 'refused':
            continue
        opened, closed = e.opening_of(called.time)
        excused = not opened < called.time < closed - 0.06 or overlaps(
            e.stalls[0], called.time, called.time + 0.05, 0.02) or overlaps(
            e.events('blocked'), called.time, called.time + 0.05, 0.5)
        yield not excused, '' if excused or any(
            called.time <= each <= called.time + 0.05 for each in halts) else \
            f'the stop of {called.time:.3f} was not sent'


def stale_calls_are_refused(e: Evidence) -> Verdicts:
    """What is called until 0.5 s after a stall is not sent, unless it reads or stops."""
    executed = executed_by(e)
    for begin, end in longer(e.stalls[0], 0.55) if e.kind == 'bus' else ():
        for called in e.story.calls:
            if called.repeatable:
                continue
            if called.time < begin and called.ended and called.ended >= end:
                late = [frame.time for frame in e.wrote if frame.begun > end + SLACK
                        and frame.content == called.request]
                before = [frame for frame in e.wrote if called.time <= frame.time <= end
                          and frame.content == called.request]
                yield 1, '' if before or not late or called.name in ('lift', 'gimbal') else \
                    f'{called.name} of {called.time:.3f} sent at {late}, a stall until {end:.3f}'
            if end < called.time < end + FRESH - SLACK:
                yield 1, '' if told(called) == 'refused' else \
                    f'{called.name} of {called.time:.3f} after a stall until {end:.3f}: ' \
                    f'{called.told}, executed {executed.get(called.request)}'


def moves_are_not_late(e: Evidence) -> Verdicts:
    """What moves is sent within the longest wait for its turn, or not at all."""
    sent = [frame for frame in e.wrote if frame.type == FUNCTION
            and frame.number in MOVES] if e.kind == 'bus' else []
    for called in e.story.calls:
        if called.repeatable:
            continue
        for frame in sent:
            if (frame.number, frame.data) == called.request[1:]:
                # It may be suspended inside the write.
                yield 1, '' if frame.time <= called.time + 5.0 + called.longest or any(
                    abs(frame.time - end) < 1e-6 for _, end in e.suspended) else \
                    f'{called.name} of {called.time:.3f} was sent at {frame.time:.3f}'


def _plain(e: Evidence) -> List[At]:
    """The requests that were written, but stops."""
    return [frame for frame in e.wrote if frame.type != FUNCTION or frame.number != HALT]


def _timeout_of(frame: At) -> float:
    return 5.0 if frame.type == FUNCTION and frame.number in (LIFT, GIMBAL) else 0.5


def one_request_is_outstanding(e: Evidence) -> Verdicts:
    """At most one request is outstanding, but for stops."""
    replies = [frame.time for frame in e.readable]
    halts = [frame.time for frame in e.wrote if frame.number == HALT]
    sent = _plain(e)
    for before, frame in zip(sent, sent[1:]):
        # Its time begins before the write, in which the bridge may have been frozen.
        begun = min([before.time, *(begin for begin, end in e.suspended if end == before.time)])
        is_free = frame.time >= begun + _timeout_of(before) - 1e-3 \
            or e.opening_of(before.time) != e.opening_of(frame.time) \
            or any(before.time <= each <= frame.time for each in replies + halts)
        # A damaged reply ends it, too.
        damaged = any(before.time <= chunk.time <= frame.time
                      for chunk in e.story.device.bridge_read)
        yield is_free or not damaged, '' if is_free or damaged else \
            f'type {frame.type} {frame.number} at {frame.time:.3f}, {before.time:.3f} outstanding'


def replies_are_used_for_their_request(e: Evidence) -> Verdicts:
    """No late or doubled reply is used for another request."""
    for called in e.story.calls:
        if called.name in ('raw', 'level', 'echo') and told(called) == 'done' \
                and not _may_take_another_reply(e, called):
            data = called.told.data
            yield 1, '' if data == called.request[2] else \
                f'{called.name} {called.request[2].hex()} of {called.time:.3f} got {data.hex()}'


def readings_are_of_the_environment(e: Evidence) -> Verdicts:
    """Every published reading was the reply to a request for it, once, in order."""
    readings = decoded(e.story.device.board_sent, reply_at, [], anywhere=True)  # noise is sent, too
    sent = [frame for frame in readings if frame.type == OK and len(frame.data) == 6
            and frame.data[2:] != b'\0\0\x88\x13']
    index = 0
    for time, _name, values, _stamp in e.story.robot.published:
        wanted = tuple(round(value * factor) for value, factor in zip(values, (1, 100, 100)))
        at = next((place for place in range(index, len(sent)) if sent[place].time <= time
                   and struct.unpack('<HhH', sent[place].data) == wanted), None)
        # The XOR of damaged bytes may be right.
        is_valid = any(e.story.device.damage_received) and struct.pack('<HhH', *wanted) in [
            frame.data for frame in e.readable if frame.time <= time]
        yield not is_valid, '' if is_valid or at is not None else \
            f'the reading {values} at {time:.3f}'
        index = index if at is None else at + 1


def moves_are_repeated_only_after_invalid(e: Evidence) -> Verdicts:
    """What moves is sent again only after an INVALID and an ECHO that has returned since."""
    calls: Dict[Tuple, int] = {}
    for called in e.story.calls:
        calls[called.request] = calls.get(called.request, 0) + 1
    sent: Dict[Tuple, List[At]] = {}
    for frame in e.wrote:
        if frame.type == FUNCTION and frame.number in MOVES:
            sent.setdefault(frame.content, []).append(frame)
    for request, frames in sent.items():
        if calls.get(request, 0) > 1:
            continue
        yield 1, '' if request in calls else f'{request} at {frames[0].time:.3f} of no call'
        for before, frame in zip(frames, frames[1:]):
            refusals = [each.time for each in e.of_type(e.readable, INVALID)
                        if before.time <= each.time <= frame.time]
            echoes = [sent for sent in e.of_type(e.wrote, ECHO) if refusals and any(
                refusals[0] <= sent.time <= each.time <= frame.time and each.data == sent.data
                for each in e.of_type(e.readable, ECHO))]
            yield 1, '' if echoes and len(frames) <= 3 else \
                f'{request} was sent again at {frame.time:.3f}'


def readings_are_repeated(e: Evidence) -> Verdicts:
    """A call that reads is sent 1 + retries times before it is not known, and no more often."""
    halts = [frame.time for frame in e.wrote if frame.number == HALT]
    for called in e.story.calls:
        if called.name != 'level':
            continue
        times = [frame.time for frame in e.wrote
                 if frame.content == called.request]
        yield 1, '' if len(times) <= 3 else f'level of {called.time:.3f} was sent at {times}'
        if told(called) == 'not known' and times and called.ended:
            closed = e.opening_of(times[0])[1]
            # It waits for its next turn for 0.8 s while the link is not in step. A function that
            # was announced goes with its announcement.
            excused = e.story.announces or closed < called.ended + SLACK \
                or called.ended > times[-1] + 0.79 \
                or any(times[0] <= each <= called.ended for each in halts) \
                or overlaps(e.stalls[0], called.time, called.ended)
            yield not excused, '' if excused or len(times) == 3 else \
                f'level of {called.time:.3f} was sent at {times}, not known at {called.ended:.3f}'


def silence_is_a_fence(e: Evidence) -> Verdicts:
    """With bus/echo false 20 ms of silence precede each call, and only callers send an ECHO."""
    if e.story.parameters['echo']:
        return
    reads = [chunk.time for chunk in e.story.device.bridge_read]
    asked = {called.request for called in e.story.calls}
    for frame in e.wrote:
        if frame.type == ECHO:
            yield 1, '' if (ECHO, 0, frame.data) in asked else f'an ECHO at {frame.time:.3f}'
        if frame.type == FUNCTION and frame.number in MOVES:
            last = max((each for each in reads if each <= frame.time), default=0.0)
            yield 1, '' if frame.time - last >= 0.02 - 1e-6 else \
                f'{frame.number} at {frame.time:.4f}, bytes at {last:.4f}'


def calls_go_before_polls(e: Evidence) -> Verdicts:
    """No poll is sent while a call waits for its turn."""
    first: Dict[Tuple, float] = {}
    for frame in e.wrote:
        first.setdefault(frame.content, frame.time)
    for frame in e.wrote:
        if frame.type != FUNCTION or frame.number != ENVIRONMENT:
            continue
        at = frame.time
        if any(called.name == 'environment' and called.time <= at <= (called.ended or at) + 0.02
               for called in e.story.calls):
            continue
        waiting = [called for called in e.story.calls if called.name in ('press', 'raw', 'level')
                   and called.time < at - SLACK and (called.ended or at) > at
                   and first.get(called.request, float('inf')) > at]
        yield 1, '' if not waiting else \
            f'a poll at {at:.3f} before {waiting[0].name} of {waiting[0].time:.3f}'


def _polls(e: Evidence) -> List[At]:
    return [frame for frame in e.wrote if frame.type == FUNCTION and frame.number == ENVIRONMENT] \
        if e.story.parameters['environment_period'] else []


def polls_go_on(e: Evidence) -> Verdicts:
    """A poll follows the answered one a period later, unless a call is there; nothing ends the
    polls."""
    period, sent = e.story.parameters['environment_period'], [each.time for each in _polls(e)]
    busy = [(called.time, called.ended or float('inf')) for called in e.story.calls] + [
        (frame.time, frame.time + 0.6) for frame in e.wrote if frame.number == HALT]
    faults = [(event.begin, event.end) for event in e.story.events if event.name != 'stop'] + [
        (asked, until) for asked, until, _, _ in e.story.tasks] + [
        (each, each) for each in e.story.device.flushes]
    noisy = any(e.story.device.damage_sent) or any(e.story.device.damage_received)
    answers = [frame.time for frame in e.of_type(e.read, OK) if len(frame.data) == 6]
    for before, at in zip(sent, [*sent[1:], float('inf')]):
        closed = e.opening_of(before)[1]
        for limit, counts in (
                (before + period + 0.12, not noisy and any(
                    before < each < before + 0.1 for each in answers)),
                # A request, its repetitions, and what brings the link back in step.
                (before + period + 6.0, True)):
            excused = not counts or min(at, closed) < limit and closed <= at or overlaps(
                busy + faults + e.stalls[0], before - 0.3, min(limit, at), 0.6) \
                or e.story.parameters['echo'] and not e.story.echoes
            yield not excused, '' if excused or at <= limit else \
                f'no poll from {before:.3f} to {at:.3f}, the period is {period}'


def polls_do_not_pile_up(e: Evidence) -> Verdicts:
    """Of three polls in a row the last comes at least a period after the first."""
    period, sent = e.story.parameters['environment_period'], _polls(e)
    answers = [time for time, *_ in e.story.robot.published]
    calls = [(called.time, called.ended or float('inf')) for called in e.story.calls
             if called.name == 'environment']
    begins = [each for before, each in zip(sent, sent[1:])
              if any(before.time < answer <= each.time for answer in answers)]
    for first, last in zip(begins, begins[2:]):
        # After a stall one is late.
        excused = e.opening_of(first.time) != e.opening_of(last.time) or overlaps(
            calls + e.stalls[0], first.time, last.time, period)
        yield not excused, '' if excused or last.time - first.time >= period - SLACK else \
            f'3 polls from {first.time:.3f} to {last.time:.3f}, the period is {period}'


def _sent(e: Evidence, called: Called) -> List[float]:
    """When the request of a call was written."""
    return [frame.time for frame in e.wrote
            if frame.content == called.request
            and called.time <= frame.time <= (called.ended or frame.time)]


_NUMBERED = 'press', 'raw', 'level'     # no two of these calls have the same request


def calls_are_in_order(e: Evidence) -> Verdicts:
    """Calls are sent in the order in which they came."""
    latest = 0.0
    for called in e.story.calls:
        times = _sent(e, called) if called.name in _NUMBERED else []
        if times:
            yield 1, '' if times[0] >= latest else \
                f'{called.name} of {called.time:.3f} was sent at {times[0]:.3f}, not in its turn'
            latest = max(latest, times[0])


def a_stop_ends_what_waits(e: Evidence) -> Verdicts:
    """What moves and waits when a stop is called is not sent."""
    for halt in e.story.calls:
        if halt.name != 'halt' or told(halt) == 'refused':
            continue
        for called in e.story.calls:
            waits = called.time < halt.time - SLACK and called.ended \
                and called.ended >= halt.time and not called.repeatable
            times = _sent(e, called) if waits else []
            if waits and not [each for each in times if each <= halt.time + SLACK]:
                yield 1, '' if not times else \
                    f'{called.name} of {called.time:.3f} was sent at {times}, after {halt.time:.3f}'


def calls_are_not_given_up(e: Evidence) -> Verdicts:
    """A call waits for others as long as a motion may take, and 0.8 s for a board that does not
    answer."""
    halts = [(called.time, called.time) for called in e.story.calls if called.name == 'halt']
    # The link sends these by itself, too.
    others = [called for called in e.story.calls if called.name not in ('halt', 'sync', 'echo')]
    reads = [chunk.time for chunk in e.story.device.bridge_read]
    for called in e.story.calls:
        if not called.told or called.told.word != 'not sent' or called.name == 'halt':
            continue
        begin, end = called.time, called.ended or 0.0
        opened, closed = e.opening_of(begin)
        served = any(
            other is not called and each <= end - SLACK and min(
                each + other.longest / 3, next((read for read in reads if read > each), end + 1.0),
                other.ended or end) > max(end - 0.78, begin)
            for other in others for each in _sent(e, other))
        excused = closed <= end + 0.02 or opened > begin or e.story.ended == end or overlaps(
            halts + e.stops + e.events('blocked', 'unplugged', 'cut') + [
                (asked, until) for asked, until, _, _ in e.story.tasks], begin, end, 0.1) \
            or overlaps(e.stalls[0], begin - FRESH - 0.2, end, 0.1) \
            or called.name in ('press', 'level') and e.story.announces \
            or e.story.parameters['echo'] and not e.story.echoes \
            or 'takes no data' in called.told.text and overlaps(
                e.events('blocked'), begin, end, 1.0)
        waited = end - begin
        yield not excused, '' if excused or waited >= 4.99 or waited >= 0.79 and not served else \
            f'{called.name} of {begin:.3f} was given up at {end:.3f}: {called.told.text}'


def refused_calls_are_repeated(e: Evidence) -> Verdicts:
    """A call that got INVALID 0x40 or 0x10 is the next one that is sent, up to 3 times, once an
    ECHO has returned."""
    if not e.story.parameters['echo']:
        return
    functions = [frame for frame in _plain(e) if frame.type == FUNCTION and frame.number != 0xFF]
    asked = [called.request for called in e.story.calls]
    calls = {called.request: called for called in e.story.calls
             if called.name != 'environment' and asked.count(called.request) == 1}
    halts = [(each, each) for each in e.story.stopped_at] + [
        (called.time, called.time) for called in e.story.calls if called.name == 'halt']
    faults = e.stops + e.events(
        'blocked', 'silence', 'reset', 'altered', 'unplugged', 'cut', 'noise')
    for refusal in e.of_type(e.read, INVALID):
        before = [frame for frame in _plain(e) if frame.time <= refusal.time][-1:]
        tries = [each for each in functions if before and each.time <= refusal.time
                 and each.content == before[0].content]
        called = calls.get(tries[-1].content) if tries else None
        if called is None or tries[-1] is not before[0] or refusal.data[:1] not in b'\x40\x10':
            continue
        following = next((frame for frame in functions if frame.time > refusal.time), None)
        limit = following.time if following else float('inf')
        # Nothing else came: neither another reply nor noise.
        replies = [frame for frame in e.read if before[0].time < frame.time <= limit]
        size = sum(len(chunk.data) for chunk in e.story.device.bridge_read
                   if before[0].time < chunk.time <= limit)
        excused = len(tries) >= 3 or overlaps(
            halts + faults + e.stalls[0], refusal.time - 0.6, min(limit, refusal.time + 5.0), 0.6) \
            or e.opening_of(refusal.time)[1] < limit or size != sum(
                len(frame.data) + 4 for frame in replies) or any(
                frame.type in (OK, ECHO) and frame.time <= refusal.time or frame.type == OK
                or frame.type == INVALID and frame is not refusal for frame in replies) \
            or refusal.time > called.time + 4.0 \
            or called.name in ('press', 'level') and e.story.announces
        is_next = following is not None and following.content == before[0].content
        yield not excused, '' if excused or is_next else \
            f'{called.name} of {called.time:.3f}, refused at {refusal.time:.3f}, was not repeated'


def a_loan_waits_for_no_move(e: Evidence) -> Verdicts:
    """No port is lent, and no board reset, while a move is under way."""
    closings = e.story.device.closings
    for asked, _, name, task in e.story.tasks:
        if not task.answer or not task.answer[0]:
            continue
        closed = min((each for each in closings if each >= asked), default=float('inf'))
        refusals = [each.time for each in e.of_type(e.readable, INVALID) if each.time <= asked]
        for called in e.story.calls:
            sent = _sent(e, called)
            cut = not called.repeatable and sent and sent[-1] < asked - SLACK and called.ended \
                and asked < called.ended and closed <= called.ended <= closed + SLACK \
                and not any(sent[-1] <= each for each in refusals)
            yield not called.repeatable, '' if not cut or overlaps(
                e.stalls[0] + e.events('unplugged', 'cut'), asked - 0.1, closed, 0.1) else \
                f'{name} of {asked:.3f} ended {called.name} of {called.time:.3f}'


def a_stop_is_repeated(e: Evidence) -> Verdicts:
    """A stop is sent again while no ECHO returns."""
    halts = [frame.time for frame in e.wrote if frame.type == FUNCTION and frame.number == HALT]
    echoes = {frame.data: frame.time for frame in e.of_type(e.readable, ECHO)}
    asked = {called.request for called in e.story.calls}
    for called in e.story.calls:
        if called.name != 'halt' or not called.ended:
            continue
        for probe in e.of_type(e.wrote, ECHO):
            due = probe.time + 0.5
            opened, closed = e.opening_of(probe.time)
            if not (opened < called.time < probe.time and due + 0.06 < min(called.ended, closed)) \
                    or (ECHO, 0, probe.data) in asked or called.time < opened:
                continue
            answered = [frame.time for frame in e.readable if probe.time <= frame.time <= due]
            excused = probe.data in echoes or answered or overlaps(
                e.stalls[0] + e.events('blocked', 'altered'), probe.time - 0.5, due + 0.06, 0.1) \
                or any(probe.time <= each <= due for each in halts)
            yield not excused, '' if excused or any(
                due - SLACK <= each <= due + 0.06 for each in halts) else \
                f'the stop of {called.time:.3f}: no ECHO to that of {probe.time:.3f}'


def unheard_moves_are_not_late(e: Evidence) -> Verdicts:
    """On a tty, a move that timed out with nothing received does not arrive later."""
    if e.story.device.kind != 'tty':
        return
    reads = [chunk.time for chunk in e.story.device.bridge_read]
    for called in e.story.calls:
        if called.repeatable or told(called) != 'not known' or not called.ended:
            continue
        sent = [frame.time for frame in e.wrote
                if frame.content == called.request]
        # One that a stop has ended is followed by the stop.
        stops = [frame for frame in e.wrote if frame.type == FUNCTION and frame.number == HALT
                 and abs(frame.time - called.ended) < SLACK]
        if len(sent) != 1 or stops or called.ended < sent[0] + called.longest / 3 - SLACK or any(
                sent[0] <= each <= called.ended for each in reads):
            continue
        late = [frame.time for frame in e.got if frame.time > called.ended + 0.015
                and frame.content == called.request]
        yield 1, '' if not late else \
            f'{called.name} of {called.time:.3f}, not known at {called.ended:.3f}, came at {late}'


def functions_are_announced(e: Evidence) -> Verdicts:
    """An announced function is sent only once its board has announced it since the opening, asked
    only with bus/announcements."""
    for frame in e.wrote:
        if frame.type != FUNCTION:
            continue
        if frame.number == 0xFF:
            yield 1, '' if e.story.announces else f'asked for an announcement at {frame.time:.3f}'
        elif e.story.announces and frame.number in (HALT, PRESS, LEVEL):
            opened = e.opening_of(frame.time)[0]
            rows = [rows for since, rows in e.story.boards if since <= frame.time][-1]
            name = {HALT: 'halt', PRESS: 'press', LEVEL: 'level'}[frame.number]
            asked = [each for each in e.wrote if each.number == 0xFF and each.type == FUNCTION
                     and opened <= each.time <= frame.time]
            yield 1, '' if asked and name in rows else \
                f'{name} at {frame.time:.3f}, opened at {opened:.3f}: the board has {rows}'


def a_lost_synchronisation_is_restored(e: Evidence) -> Verdicts:
    """After INVALID 0x10 the next request, but for a stop, is SYNC."""
    sent = _plain(e)
    for frame in e.of_type(e.read, INVALID):
        if frame.data[:1] != b'\x10':
            continue
        following = next((each for each in sent if each.time > frame.time), None)
        before = [each for each in sent if each.time <= frame.time]
        returned = [each.time for each in e.of_type(e.readable, ECHO) if each.time <= frame.time]
        excused = following is None or following.time > e.opening_of(frame.time)[1] or not before \
            or before[-1].type == SYNC or overlaps(
                e.stalls[0], frame.begun, frame.time, FRESH + 0.1) \
            or sum(each.type == ECHO and each.time > max(returned, default=0.0)
                   for each in before) > 2      # after three without an answer one times out first
        yield not excused, '' if excused or following.type == SYNC else \
            f'type {following.type} {following.number} at {following.time:.3f} after 0x10'


def refusals_are_confirmed(e: Evidence) -> Verdicts:
    """INVALID is told as refused only when an ECHO has returned since; what was sent is never told
    as not sent."""
    invalids = [frame.time for frame in e.of_type(e.readable, INVALID)]
    echoes = [frame.time for frame in e.of_type(e.readable, ECHO)]
    asked: Dict[Tuple, int] = {}
    for called in e.story.calls:
        asked[called.request] = asked.get(called.request, 0) + 1
    for called in e.story.calls:
        sent = [frame.time for frame in e.wrote
                if frame.content == called.request]
        if asked[called.request] > 1 or not called.told \
                or called.name in ('sync', 'environment', 'halt'):      # others send them, too
            continue
        if called.told.word == 'not sent':
            yield 1, '' if not sent else f'{called.name} of {called.time:.3f} was sent at {sent}'
        elif called.told.word == 'refused':
            refused = [each for each in invalids if sent and sent[-1] <= each <= called.ended]
            right = refused and any(refused[-1] <= each <= called.ended for each in echoes)
            yield 1, '' if right else \
                f'{called.name} of {called.time:.3f} was refused at {called.ended:.3f}, no ECHO'


def calls_end_with_their_port(e: Evidence) -> Verdicts:
    """When the port closes, an outstanding call is not known, at once."""
    for called in e.story.calls:
        sent = [frame.time for frame in e.wrote
                if frame.content == called.request
                and called.time <= frame.time <= (called.ended or frame.time)]
        closed = e.opening_of(sent[-1])[1] if sent else float('inf')
        if called.name == 'halt' or not called.ended or closed > called.ended + 1e-6 \
                or closed >= e.story.world.time - 1.1:
            continue
        excused = overlaps(e.stalls[0], closed, called.ended)
        yield not excused, '' if excused or called.ended <= closed + 0.15 else \
            f'{called.name} of {called.time:.3f} ended at {called.ended:.3f}, closed {closed:.3f}'


def a_board_without_echo_gets_no_call(e: Evidence) -> Verdicts:
    """With bus/echo true a board that knows no ECHO gets no call: each is told as not sent."""
    if not e.story.parameters['echo'] or e.story.echoes:
        return
    for called in e.story.calls:
        if called.ended and called.name not in ('halt', 'sync', 'echo'):
            yield 1, '' if told(called) == 'refused' else \
                f'{called.name} of {called.time:.3f}: {called.told}'
    for time, report in e.story.reports:
        yield 1, '' if report['condition'] != 'ok' else f'ok at {time:.3f}'
