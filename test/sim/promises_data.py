"""What is promised of data, settings and ports."""
import struct
from math import isfinite
from typing import Dict, List, Tuple

from evidence import FRAME_TIMEOUT, At, Evidence, longer, overlaps
from promises import FRESH, IMU, SETTING, SLACK, STALL, Verdicts

NAMES = {8: ('Ticks',), 7: ('SteeringAngle',), 10: ('Voltage',), 9: ('Imu',), 32: ('force', 'push'),
         0x10: ('SensorStatus',)}
ALL_NAMES = {name for names in NAMES.values() for name in names}
LAYOUTS = {8: '<B', 7: '<H', 10: '<f', 9: '>11h', 32: '<h', 0x10: '<HHhhh'}


def raw(e: Evidence, name: str, values: Tuple) -> Tuple:
    """Published values as the raw numbers of the wire."""
    if name == 'force':
        return (round(values[0] / 0.01),)
    if name == 'SensorStatus':
        return tuple(values[:2])
    return values


def on_wire(e: Evidence, frame: At) -> Tuple:
    numbers = struct.unpack(LAYOUTS[frame.type], frame.data)
    return numbers[:2] if frame.type == 0x10 else numbers


def valid(frames: List[At]) -> List[At]:
    """Those whose values may be published."""
    return [frame for frame in frames if frame.type in NAMES
            and struct.calcsize(LAYOUTS[frame.type]) == len(frame.data)]


def values_are_of_frames(e: Evidence) -> Verdicts:
    """Every published value was in a valid frame, once, in order."""
    if e.kind == 'bus':
        return
    frames, index = valid(e.readable), 0
    for time, name, values, _stamp in e.story.robot.published:
        if name not in ALL_NAMES:
            continue
        wanted, at = raw(e, name, values), index
        while at < len(frames) and not (name in NAMES[frames[at].type]
                                        and on_wire(e, frames[at]) == wanted):
            at += 1
        if at == len(frames):
            yield 1, f'{name} {values} at {time:.3f} was in no frame, or twice, or out of order'
            return
        index = at + 1
        yield 1, ''


def no_stale_value(e: Evidence) -> Verdicts:
    """No value that waited during a stall of over 0.5 s is published."""
    for begin, end in longer(e.stalls[0], 0.55):
        opened, closed = e.opening_of(begin)
        if end < e.openings[0][0]:
            continue
        for time, name, _values, _stamp in e.story.robot.published:
            if end - 1e-9 <= time < min(end + FRESH - SLACK, closed) and name in ALL_NAMES:
                yield 1, f'{name} at {time:.3f}, after a stall until {end:.3f}'
        yield 1, ''


def frames_are_published(e: Evidence) -> Verdicts:
    """Every valid frame is published, but during a stall and just after it."""
    if e.kind == 'bus':
        return
    published: Dict[Tuple, List[float]] = {}
    for time, name, values, _stamp in e.story.robot.published:
        if name in ALL_NAMES:
            published.setdefault((name, raw(e, name, values)), []).append(time)
    rows_change = [(begin, begin + 30.0) for begin, _ in e.events('unplugged')] + [
        (opened, opened + 14.0) for opened, _ in e.openings]
    for frame in valid(e.read):
        names, wanted = NAMES[frame.type], on_wire(e, frame)
        times = published.get((names[0], wanted)) or published.get((names[-1], wanted), [])
        at = next((time for time in times if frame.time - 1e-9 <= time <= frame.time + 0.08), None)
        if at is not None:
            times.remove(at)
            yield 1, ''
            continue
        excused = overlaps(e.stalls[0], frame.begun, frame.time + 0.06, FRESH + 0.11) \
            or frame.type == 32 and overlaps(
                rows_change + e.events('reset', 'silence') + e.stalls[0],
                frame.time, frame.time, 14.0 if e.story.announces else 0.0) \
            or frame.type in (9, 10, 7) and implausible(frame) \
            or frame.time - frame.begun > 0.04 or overlaps(
                e.events('altered'), frame.begun - 1.0, frame.time, 0.6) \
            or any(0.04 < frame.begun - chunk.time < 0.06 for chunk in e.story.device.bridge_read) \
            or any(frame.begun - 0.02 <= each <= frame.time + FRAME_TIMEOUT + 0.01
                   for each in e.story.device.flushes + [    # it may wait in a damaged frame
                       end for _, end in e.openings])
        yield not excused, '' if excused else \
            f'{names[0]} {wanted} read at {frame.time:.3f} was not published'


def implausible(frame: At) -> bool:
    """Whether its values are impossible."""
    return are_implausible(frame.type, struct.unpack(LAYOUTS[frame.type], frame.data))


def are_implausible(type_: int, values: Tuple) -> bool:
    """Likewise, of the values of a packet of the car."""
    if type_ == IMU:
        return not 0.95 < sum(each * each for each in values[:4]) ** 0.5 / 16384 < 1.05
    return not 0 <= values[0] <= (100 if type_ == 10 else 1024)


def stamps_are_of_the_read(e: Evidence) -> Verdicts:
    """A stamp is that of the read of the last byte, or an earlier one by the board's clock."""
    reads = {chunk.time for chunk in e.story.device.bridge_read}
    for time, name, _values, stamp in e.story.robot.published:
        if name in ALL_NAMES:
            delayed = 0.12 + (1.0 if e.story.drift is not None else 0.0)
            yield 1, '' if (stamp in reads or e.story.drift is not None) and stamp <= time and (
                time <= stamp + delayed or overlaps(e.stalls[0], stamp, time)) else \
                f'{name} at {time:.3f} has the stamp {stamp:.3f}'


def stamps_are_of_the_measurement(e: Evidence) -> Verdicts:
    """With the board's clock, stamps on an undamaged line are within 7 ms of the measurement, 10 ms
    behind an adapter of 16 ms."""
    device, drift = e.story.device, e.story.drift
    if drift is None or any(device.damage_received) or e.events('noise', 'altered'):
        return
    measured: Dict[Tuple, List[float]] = {}     # the ranges of the sensors may come again
    for frame in valid(e.sent):
        if frame.type in (IMU, 0x10):
            measured.setdefault((NAMES[frame.type][0], on_wire(e, frame)), []).append(frame.time)
    first = dict.fromkeys((opened for opened, _ in e.openings), float('inf'))
    for time, name, values, stamp in e.story.robot.published:
        times = measured.get((name, raw(e, name, values)))
        opened, _ = e.opening_of(time)
        if not times or opened not in first:
            continue
        first[opened] = min(first[opened], time)
        # A restart of the board's clock, and a stall, begin anew.
        excused = time < first[opened] + 2.5 or overlaps(
            longer(e.stalls[0], STALL) + e.events('reset', 'silence') + [
                (each, each) for each in device.flushes], time - 3.0, time)
        at = min(times, key=lambda each: abs(each - stamp))
        # A line from few points may be 1 % too steep.
        limit = 0.01 if device.hold > 0.01 else 0.007
        yield not excused, '' if excused or abs(stamp - at) <= limit else \
            f'{name} of {at:.4f} has the stamp {stamp:.4f}, published {time:.4f}'


def silence_is_reported(e: Evidence) -> Verdicts:
    """A silent sensor board is reported each second, without values."""
    if e.kind != 'mcu':
        return
    said = [time for time, *_ in e.story.robot.published]
    for last, following in zip(said, said[1:]):
        excused = overlaps(e.stalls[0], last, following, 0.7)
        yield not excused, '' if excused or following - last <= 1.15 else \
            f'nothing was published from {last:.3f} to {following:.3f}'


def settings_are_in_use(e: Evidence) -> Verdicts:
    """A setting that is told as confirmed is what the board has reported last."""
    if e.kind == 'bus':
        return
    # A report that comes just after a stall may be dropped.
    reports = [(frame.time, frame.data, not overlaps(
        e.stalls[0], frame.begun, frame.time, FRESH + 0.11))
        for frame in e.of_type(e.read, SETTING)]
    for time, report in e.story.reports:
        if report['condition'] not in ('ok', 'silent') or 'settings' not in report \
                or report['settings unconfirmed'] or overlaps(
                    e.stalls[0], time - 1.0, time) or e.events('noise'):
            continue
        opened = e.opening_of(time)[0]
        for name, number, layout in ('kp', 1, '<f'), ('limit', 2, '<H'):
            wanted = [value for at, each, value in e.story.wants if each == name and at <= time]
            seen: List[float] = []      # the last one that counts, and those that may
            for at, data, counts in reports:
                if opened <= at <= time and data[:1] == bytes((number,)) \
                        and len(data) == 1 + struct.calcsize(layout) \
                        and isfinite(struct.unpack(layout, data[1:])[0]):
                    # A damaged frame before it may keep it for 50 ms.
                    seen = [] if counts and at < time - 0.06 else seen
                    seen.append(struct.unpack(layout, data[1:])[0])
            if wanted and seen and name in report['settings']:
                yield 1, '' if wanted[-1] in seen else \
                    f'{name} is told as confirmed at {time:.3f}: wanted {wanted[-1]}, has {seen}'


def setting(name: str, value: float) -> bytes:
    """The data of a frame that sets this."""
    return struct.pack('<Bf', 1, value) if name == 'kp' else struct.pack('<BH', 2, int(value))


def settings_are_sent(e: Evidence) -> Verdicts:
    """A wanted setting is sent at once, and after 0.2 s again unless the board has reported it."""
    if e.kind == 'bus' or e.story.announces:
        return
    wants: Dict[str, float] = {}
    wrote, read = e.of_type(e.wrote, SETTING), e.of_type(e.readable, SETTING)
    disturbed = e.stalls[0] + e.stalls[-1] + e.events('blocked', 'altered', 'unplugged', 'cut') + [
        (asked, until) for asked, until, _, _ in e.story.tasks] + e.events('silence')
    for index, (time, name, value) in enumerate(e.story.wants):
        data, before = setting(name, value), wants.get(name)
        wants[name] = value
        opened, closed = e.opening_of(time)
        following = [at for at, each, _ in e.story.wants[index + 1:] if each == name][:1]
        times = [frame.time for frame in wrote if frame.data == data and frame.time >= time]
        excused = before == value or opened > time - 0.5 or closed < time + 0.6 or overlaps(
            disturbed, time - 0.1, time + 0.6, 0.6) or following and following[0] < time + 0.6 \
            or any(on and at < time + 0.6 for at, on in e.story.robot.calibrating)
        yield not excused, '' if excused or times and times[0] <= time + 0.3 else \
            f'{name} = {value} of {time:.3f} was not sent'
        if not excused and times and not any(
                frame.data[:1] == data[:1] and time < frame.time < times[0] + 0.25
                for frame in read):
            yield 1, '' if len(times) > 1 and times[1] <= times[0] + 0.3 else \
                f'{name} = {value} was sent at {times[0]:.3f}, and not again'


def settings_leave_room(e: Evidence) -> Verdicts:
    """At most 20 frames with settings are sent in any second."""
    times = [frame.time for frame in e.of_type(e.wrote, SETTING)] if e.kind != 'bus' else []
    for index, time in enumerate(times):
        count = sum(each < time + 1.0 for each in times[index:])
        yield 1, '' if count <= 20 else f'{count} settings in the second from {time:.3f}'


def the_port_is_opened_again(e: Evidence) -> Verdicts:
    """A port that is back is opened, and its board heard, within 1.2 s."""
    gone = e.events('unplugged')
    for begin, end in gone:
        if end + 1.3 > e.story.world.time - 1.0 or overlaps(
                [each for each in gone if each != (begin, end)] + e.stalls[0]
                + [(asked, until) for asked, until, name, _ in e.story.tasks if name == 'lend'],
                begin, end + 1.3):
            continue
        yield 1, '' if overlaps(e.openings, end, end + 1.2) else f'not opened after {end:.3f}'
