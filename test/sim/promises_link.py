"""What is promised of every link: its taps, its counters, its condition, its port."""
import struct
from collections import Counter
from typing import Any, Callable, Iterator, Set, Tuple

from by_definition import arduino_at, decode, mcu_at, reply_at, request_at
from evidence import FRAME_TIMEOUT, Evidence, longer, merged, overlaps
from promises import FRESH, HEARTBEAT, IMU, SETTING, SLACK, STALL, TIME, Verdicts
from promises_data import LAYOUTS, are_implausible, setting

_RX, _TX = 0, 1
_MCU_LENS = {0x10: 12, 0x01: 14, 0xFE: 6}


def _is_calm(e: Evidence) -> bool:
    """Nothing was damaged, nothing disturbed the link, and all types were known from the start."""
    device = e.story.device
    return not (e.kind != 'bus' and e.story.announces) \
        and not any(device.damage_sent) and not any(device.damage_received) \
        and not e.stalls[0] and not [each for each in e.story.events if each.name != 'stop']


def _decoders(e: Evidence) -> Tuple:
    """Those of received and of sent frames."""
    return {'bus': (reply_at, request_at), 'arduino': (arduino_at, arduino_at),
            'mcu': (mcu_at, mcu_at)}[e.kind]


def sent_frames_are_tapped(e: Evidence) -> Verdicts:
    """Every frame that is sent is in serial_msg, once, in order."""
    tapped = b''.join(raw for direction, raw, _ in e.story.robot.tapped if direction == _TX)
    if not e.story.robot.tapped or e.events('blocked', 'unplugged', 'cut') or len(
            e.openings) > 1:
        return      # a frame may be cut
    frames = decode(tapped, _decoders(e)[1], True)[0]
    yield len(frames), '' if [each.content for each in frames] == [
        each.content for each in e.wrote] else \
        f'{len(frames)} frames were tapped, {len(e.wrote)} were sent'


def received_frames_are_tapped(e: Evidence) -> Verdicts:
    """Every frame that is received is in serial_msg, once, in order."""
    tapped = [decode(raw, _decoders(e)[0], True)[0] for direction, raw, cause in
              e.story.robot.tapped if direction == _RX and not cause]
    frames, index = e.readable, 0
    for found in tapped:
        for frame in found[:1]:
            at = next((place for place in range(index, len(frames)) if (
                frames[place].type, frames[place].number, frames[place].data) == frame.content),
                None)
            yield 1, '' if at is not None else f'{frame} was tapped and not received'
            index = index if at is None else at + 1
    if e.story.robot.tapped and _is_calm(e) and len(e.openings) == 1:
        # The stop of the bridge may come before the last of them.
        missing = len(e.read) - len(tapped)
        yield 1, '' if 0 <= missing <= 6 else f'{missing} of {len(e.read)} were not tapped'


def bytes_are_counted(e: Evidence) -> Verdicts:
    """`bytes received` and `bytes sent` are exact."""
    device = e.story.device
    for time, report, read, wrote, *_ in e.story.counted:
        for name, chunks in ('bytes received', device.bridge_read[:read]), (
                'bytes sent', device.bridge_wrote[:wrote]):
            count = sum(len(chunk.data) for chunk in chunks)
            # Bytes of the read that found the loss of the port are dropped.
            right = report[name] == count or report[name] <= count and (
                e.events('unplugged', 'cut') or e.story.tasks)
            yield 1, '' if right else f'{name} at {time:.3f}: {report[name]}, not {count}'


def frames_are_counted(e: Evidence) -> Verdicts:
    """`frames received`, `frames sent` and `heartbeats sent` are those of serial_msg and of the
    line."""
    beats, whole = e.of_type(e.wrote, HEARTBEAT), not e.events('blocked', 'unplugged', 'cut')
    for time, report, read, wrote, tapped, _ in e.story.counted:
        for name, sent in ('frames sent', e.wrote), ('heartbeats sent', beats):
            if name in report and whole and not overlaps(e.suspended, time, time, 0.02):
                count = sum(frame.time <= time for frame in sent)
                yield 1, '' if report[name] == count else \
                    f'{name} at {time:.3f}: {report[name]}, written {count}'
        frames = e.story.robot.tapped[:tapped]
        for name, direction in (('frames received', _RX), ('frames sent', _TX)) if frames else ():
            count = sum(each == direction and not cause for each, _, cause in frames)
            yield 1, '' if report[name] == count else \
                f'{name} at {time:.3f}: {report[name]}, tapped {count}'
        if _is_calm(e) and len(e.openings) == 1 and not e.story.device.flushes:
            data = b''.join(chunk.data for chunk in e.story.device.bridge_read[:read])
            count = len(decode(data, _decoders(e)[0])[0])
            yield 1, '' if report['frames received'] == count else \
                f'frames received at {time:.3f}: {report["frames received"]}, on the line {count}'


def errors_are_counted(e: Evidence) -> Verdicts:
    """Every invalid frame is counted once, by its cause; a good line has no errors."""
    names = 'checksum errors', 'framing errors'
    for time, report, _, _, tapped, _ in e.story.counted:
        causes = {key: value for key, value in report.items() if key.endswith(' errors')}
        if _is_calm(e) and not e.story.tasks:
            yield 1, '' if not any(causes.values()) else f'{causes} at {time:.3f}'
        if e.story.robot.tapped:
            for name in names:
                count = sum(direction == _RX and cause + ' errors' == name
                            for direction, _, cause in e.story.robot.tapped[:tapped])
                # Noise that began in old bytes is an error, and is not shown.
                yield 1, '' if causes[name] == count or causes[name] > count and longer(
                    merged(e.stalls[0]), STALL) else \
                    f'{name} at {time:.3f}: {causes[name]}, tapped {count}'


def damage_is_counted(e: Evidence) -> Verdicts:
    """The counts of errors are those that the definition of the protocol gives."""
    device, sent = e.story.device, {each.content for each in e.sent}
    # A stall, and the loss of a port, drop what is not counted yet. When noise that comes byte by
    # byte, or in which a frame seems to begin, is given up, depends on the reads.
    end = min([begin for begin, _ in e.stalls[0] + e.events('altered', 'unplugged', 'cut')]
              + [each.begin for each in e.story.events if each.name == 'noise' and (
                  not each.value or e.kind != 'arduino' and set(each.value) & set(b'\xA5\x5A\x02'))]
              + device.closings + device.flushes
              + [asked for asked, *_ in e.story.tasks] + [float('inf')])
    counts, silent, stream = Counter(), 0.0, b''        # type: ignore[var-annotated]
    chunks = [chunk for chunk in device.bridge_read if chunk.time < end]
    at = 0
    for time, report, *_ in e.story.counted:
        while at < len(chunks) and chunks[at].time < time:
            chunk = chunks[at]
            at += 1
            gap = chunk.time - silent
            if stream and gap > FRAME_TIMEOUT:
                counts.update(errors_of(stream, _decoders(e)[0], sent))
                stream = b''
            # Whether the frame is given up before these bytes depends on their length.
            if gap > 0.04 and chunk.time - silent < 0.06 or counts['unsure'] or time >= end:
                return
            stream, silent = stream + chunk.data, chunk.time
        if time >= end:
            return
        if time - silent > 0.1:
            counts.update(errors_of(stream, _decoders(e)[0], sent))
            stream = b''
            if counts['unsure']:
                return
            for cause in ('checksum', 'framing', 'length', 'implausible'):
                said = report.get(cause + ' errors', 0)
                if e.kind != 'bus' or cause in ('checksum', 'framing'):
                    yield 1, '' if said == counts[cause] else \
                        f'{said} {cause} errors at {time:.3f}, not {counts[cause]}'


def errors_of(stream: bytes, frame_at: Callable, sent: Set[Tuple]) -> Iterator[str]:
    """The causes of all errors in these bytes, by the definition; `unsure`: it does not tell."""
    if frame_at is arduino_at:
        for packet in stream.split(b'\0'):
            found = arduino_at(packet + b'\0', 0)
            # The rest without a 0x00 at its end is incomplete.
            if packet and (found is None or stream.endswith(packet) and packet == stream.split(
                    b'\0')[-1]):
                yield 'framing' if len(packet) < 255 else 'unsure'
            elif packet and found.content not in sent:
                yield unlike(found)
        return
    at = classified = 0
    while at < len(stream):
        found = frame_at(stream, at)
        if isinstance(found, str):
            found = None        # no more bytes follow
        size = len(stream) if found else damaged_size(stream, at, frame_at is mcu_at)
        if found or size and at >= classified:
            if at > classified:
                yield 'framing'
            classified = found.end if found else at + size
            if found is None:
                yield 'checksum'
            elif found.content not in sent:
                yield 'unsure'
        at = found.end if found else at + 1
    if classified < len(stream):
        yield 'framing'


def unlike(packet: Any) -> str:
    """The cause of the error of a packet that the board has not sent like this."""
    if packet.type not in LAYOUTS:
        return 'unsure' if packet.type < 4 or packet.type > 250 else 'unknown type'
    if len(packet.data) != struct.calcsize(LAYOUTS[packet.type]):
        # A row that is announced may not be in use.
        return 'unknown type' if packet.type == 0x10 else 'unsure' if packet.type == 32 \
            else 'length'
    values = struct.unpack(LAYOUTS[packet.type], packet.data)
    return 'implausible' if packet.type in (7, 9, 10) and are_implausible(packet.type, values) \
        else 'valid'


def damaged_size(stream: bytes, at: int, is_mcu: bool) -> int:
    """The size of the whole frame here whose checksum does not match; 0: there is none."""
    size = len(stream) - at
    if is_mcu:
        if size < 3 or stream[at] != 0x02 or stream[at + 1] < 2 \
                or _MCU_LENS.get(stream[at + 2], stream[at + 1]) != stream[at + 1]:
            return 0
        whole = stream[at + 1] + 4
        return whole if whole <= size and stream[at + whole - 1] == 0x03 else 0
    if stream[at] not in b'\xA5\x5A' or size < 3:
        return 0
    is_long = stream[at] == 0x5A
    count = int.from_bytes(stream[at + 1:at + 2 + is_long], 'little')
    whole = count + 4 + is_long
    return whole if whole <= size and (count < 255) != is_long and count <= 1024 else 0


def lost_frames_are_counted(e: Evidence) -> Verdicts:
    """Every lost frame of the sensor board is counted, by its SEQ."""
    if e.kind != 'mcu':
        return
    # What waited during a stall is dropped by the bridge itself.
    end = min([begin for begin, _ in e.stalls[0] + e.events('noise', 'altered')] + [
        drop for drop in e.story.device.drops + [end for _, end in e.openings]  # so is what waits
        if any(drop - FRAME_TIMEOUT - 0.01 < frame.time <= drop for frame in e.read)
    ] + [float('inf')])
    for time, report, *_ in e.story.counted:
        if time >= end:
            return
        lost, last = 0, None
        for frame in e.read:
            if frame.time > time - 0.06:
                break
            opened = e.opening_of(frame.time)
            same = last and last[1] == opened
            if not (same and last[0].data == frame.data and last[0].number == frame.number):
                lost += (frame.number - last[0].number - 1) % 256 if same else 0
            last = frame, opened
        recent = [frame for frame in e.read if time - 0.06 < frame.time <= time]
        yield not recent, '' if recent or report['frames lost'] == lost else \
            f'{report["frames lost"]} lost at {time:.3f}, not {lost}'


def stale_bytes_are_counted(e: Evidence) -> Verdicts:
    """What waits when the link begins anew is dropped and counted, on the bus decoded."""
    device, counted = e.story.device, e.story.counted
    stalls = longer(merged(e.stalls[0]), STALL)
    for (last, before, *_), (time, report, *_) in zip(counted, counted[1:]):
        more = report['stale'] - before['stale']
        if e.kind == 'bus' or not overlaps(stalls, last, time, 0.7) and not any(
                last <= each <= time for each in device.flushes):
            yield 1, '' if not more else f'{more} bytes are stale at {time:.3f}'
            continue
        # Of a stall of which the loop knows: its end is between the two reports.
        long = [(begin, end) for begin, end in longer(e.stalls[0], 0.55)
                if last < end and e.opening_of(begin)[1] > end]
        count = sum(len(chunk.data) for chunk in device.bridge_read if any(
            end <= chunk.time < min(end + 0.45, time) for _, end in long))
        yield 1, '' if more >= count or e.events('unplugged', 'cut') or e.story.tasks else \
            f'{more} bytes are stale at {time:.3f}, {count} were old'


def conditions_are_true(e: Evidence) -> Verdicts:
    """`condition` is closed, lent, stopped, calibrating, silent or ok, as it is."""
    story, device = e.story, e.story.device
    changes = [task[:2] for task in story.tasks] + [(at - SLACK, at) for at in device.closings]
    for time, report in story.reports:
        name = report['condition']
        opened, closed = e.opening_of(time)
        if overlaps(e.stops, time - 1e-6, time + 1e-6):
            if any(abs(time - each) < 1e-6 for stop in e.stops for each in stop):
                continue
            yield 1, '' if name == 'stopped' else f'{name} at {time:.3f}, while ~stop holds'
            continue
        if overlaps(e.stalls[0] + changes + e.events('cut', 'unplugged'), time - 0.2, time, 0.3):
            may = None
        elif opened == float('inf') or time < opened + SLACK:
            may = ('closed',) if opened == float('inf') else None
        elif overlaps(e.calibrations, time - 0.1, time, 0.1):
            may = ('calibrating',) if overlaps(e.calibrations, time, time) else None
        elif e.kind == 'bus':
            synced = any(opened <= frame.time <= time for frame in e.readable if frame.type == 0)
            may = ('ok', 'out_of_step', 'no_echo', 'not_synchronised') if synced else (
                'not_synchronised',)
        else:
            heard = [frame.time for frame in e.readable if frame.time <= time]
            age = time - heard[-1] if heard else float('inf')
            # Of a doubtful age either is right; a longer stall may have dropped the last ones.
            may = ('ok',) if age < 0.6 and opened < time - 1.5 and not overlaps(
                e.stalls[0] + e.events('noise', 'altered', 'silence', 'reset'), time - 1.5, time,
                0.6) and e.read and e.read[-1].time > time - 0.3 else \
                ('silent',) if age > 1.1 else ('ok', 'silent')
        yield may is not None, '' if may is None or name in may else \
            f'{name} at {time:.3f}, not {may}; open from {opened:.3f} to {closed:.3f}'


def a_loan_is_told(e: Evidence) -> Verdicts:
    """`condition` is lent while a loan runs."""
    for asked, until, name, task in e.story.tasks:
        if name != 'lend' or not task.answer or not task.answer[0]:
            continue
        for time, report in e.story.reports:
            if asked + 0.3 < time < until - SLACK and not overlaps(e.stalls[0], asked, time, 0.1):
                yield 1, '' if report['condition'] in ('lent', 'stopped') else \
                    f'{report["condition"]} at {time:.3f}, lent from {asked:.3f} to {until:.3f}'


def a_silent_network_is_opened_again(e: Evidence) -> Verdicts:
    """A network port that is silent for network_silence is opened again, not sooner."""
    if e.kind == 'bus' or e.story.device.kind != 'network':
        return
    limit, device = e.story.parameters['network_silence'], e.story.device
    calibrates = [time for time, _ in e.story.robot.calibrating]
    reads = [chunk.time for chunk in device.bridge_read]
    talked = min([frame.time for frame in e.read] + [float('inf')])
    for opened, closed in e.openings:
        times = [opened, *(each for each in reads if opened <= each <= closed), closed]
        for last, following in zip(times, times[1:]):
            excused = last < talked or overlaps(e.stalls[0], last, following, 0.2) or any(
                each <= following + 0.2 for each in calibrates)
            if following - last > limit - 0.5:
                yield not excused, '' if excused or following - last <= limit + 0.2 else \
                    f'nothing was read from {last:.3f} to {following:.3f}, and it stayed open'


def reconnects_are_counted(e: Evidence) -> Verdicts:
    """`reconnects` is how often the port was opened again."""
    openings = e.story.device.openings
    for time, report in e.story.reports:
        count = max(sum(each <= time for each in openings) - 1, 0)
        near = any(abs(each - time) < 0.01 for each in openings) or overlaps(
            e.stalls[0], time, time, 0.01)
        yield not near, '' if near or report['reconnects'] == count else \
            f'{report["reconnects"]} reconnects at {time:.3f}, not {count}'


def settings_of_the_port_are_restored(e: Evidence) -> Verdicts:
    """Settings of a tty that another program changed are restored within 1.2 s."""
    for time, _ in e.events('altered'):
        opened, closed = e.opening_of(time)
        excused = closed < time + 1.2 or opened == float('inf') or overlaps(
            e.stalls[0], time, time + 1.2, 0.01)
        yield not excused, '' if excused or any(
            time <= each <= time + 1.2 for each in e.story.device.restorations) else \
            f'not restored after {time:.3f}'


def loans_are_fresh(e: Evidence) -> Verdicts:
    """Until 0.5 s after a stall no loan and no reset is accepted."""
    for begin, end in longer(e.stalls[0], 0.55):
        for asked, _, name, task in e.story.tasks:
            if end < asked < end + FRESH - SLACK and task.answer:
                yield 1, '' if not task.answer[0] else \
                    f'{name} of {asked:.3f} after a stall until {end:.3f}'


def announced_rows_are_in_use(e: Evidence) -> Verdicts:
    """The rows that the board has announced last are in use, and no others."""
    story = e.story
    for time, report in story.reports if story.announces else ():
        since, rows = [each for each in story.boards if each[0] <= time][-1]
        if report.get('announced'):
            known = [rows for begin, rows in story.boards if begin <= time]
            yield 1, '' if report['announced'].split(', ') in known else \
                f'{report["announced"]} at {time:.3f}'
        opened, _ = e.opening_of(time)
        excused = not opened < time - 6.0 or since > time - 6.0 or any(
            story.device.damage_received) or any(story.device.damage_sent) or overlaps(
            e.stalls[0] + [(event.begin, event.end) for event in story.events],
            time - 6.0, time) or e.kind == 'bus' and not story.echoes
        yield not excused, '' if excused or report.get('announced') == ', '.join(rows) else \
            f'{report.get("announced")} at {time:.3f}, the board has {rows} since {since:.3f}'


def wanted_settings_return(e: Evidence) -> Verdicts:
    """After a reset of the board all wanted settings are back within 1 s of its first report."""
    story = e.story
    if e.kind == 'bus' or story.announces or any(story.device.damage_sent) or any(
            story.device.damage_received):
        return
    boots = [time for time, event, _ in story.far.notes if event == 'boot']
    for boot in boots:
        heard = next((frame.time for frame in e.of_type(e.read, SETTING) if frame.time > boot),
                     float('inf'))
        opened, closed = e.opening_of(boot)
        excused = closed < heard + 1.0 or opened == float('inf') or overlaps(
            e.stalls[0] + e.stalls[-1] + e.events(
                'blocked', 'silence', 'altered', 'unplugged', 'noise', 'cut'),
            boot - 0.6, heard + 1.0, 0.6) or any(
            boot - 20.0 < time <= heard + 1.0 for time, _ in story.robot.calibrating) or any(
            boot < each <= heard + 1.0 for each in boots)
        if excused or heard == float('inf'):
            continue
        for name in 'kp', 'limit':
            values = [value for at, each, value in story.wants if each == name and at <= boot]
            later = [at for at, each, _ in story.wants if each == name and boot < at < heard + 1.0]
            if values and not later:
                data = setting(name, values[-1])
                yield 1, '' if any(frame.data == data and boot < frame.time <= heard + 1.0 for frame
                                   in e.of_type(e.got + e.read, SETTING)) else \
                    f'{name} {values[-1]} is not back after the reset of {boot:.3f}'


def damage_does_not_bend_the_line(e: Evidence) -> Verdicts:
    """A damaged TIME makes no other stamp over 10 ms early."""
    if e.story.drift is None or not any(e.story.device.damage_received) or e.kind != 'arduino':
        return
    measured = {frame.data: frame.time for frame in e.of_type(e.sent, IMU)}
    times = {frame.data for frame in e.of_type(e.sent, TIME)}
    undamaged, is_damaged = {}, False      # Imus behind a TIME that was sent
    for frame in e.of_type(e.readable, IMU, TIME):
        if frame.type == TIME:
            if is_damaged and frame.data not in times:
                break       # two in a row may agree: then they confirm each other
            is_damaged = frame.data not in times
        elif frame.data in measured and not is_damaged:
            undamaged[struct.unpack('>11h', frame.data)] = measured[frame.data]
    for time, name, values, stamp in e.story.robot.published:
        at = undamaged.get(tuple(values)) if name == 'Imu' else None
        if at is not None:
            yield 1, '' if stamp >= at - 0.01 else \
                f'Imu of {at:.4f} has the stamp {stamp:.4f}, published at {time:.4f}'
