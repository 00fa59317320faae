"""Reads the records of a campaign and holds every invariant against them."""
import glob
import os
import time
from bisect import bisect_left, bisect_right
from typing import Any, Dict, List, NamedTuple, Set, Tuple

import genpy
from roslib.message import get_message_class
from tf2_msgs.msg import TFMessage

from serial_communication.msg import SerialMsg

from serial_communication.tools.watch.topics import NODE
from .align import Sent
from .check_bus import check_bus, outcomes
from .check_frames import check_published
from .check_heartbeat import check_heartbeat
from .check_interference import (Connection, check_frozen_line, check_master, check_network,
                                 check_standstill, check_unread, opened_anew)
from .check_lost import Told, check_lost_frames, frame_of, heard_of
from .check_motor import check_motor, prepare
from .check_node import RETURN, check_level, check_log, check_returns, log_lines
from .check_own import check_own_commands
from .expected import LINKS, RECORDED, TOPICS, Arrival, arrivals, expected
from .packets import HEARTBEAT, SPEED, Packet, calibrations, closed_times, fault_times, packets_of
from .records import Intervals, read_lines, read_messages, stretches
from .run import SPEED_TIMEOUT, TIMEOUTS, excuses_of_calls
from .table import Row

ENDING = 2.0             # s that the node may take to end
_SETTLING = 60.0         # s after which memory is level; a third of a shorter campaign
_BEFORE_A_CUT = 0.15     # s of data that may be lost with a port
_AFTER_DATA = 0.05       # s after the first data behind a port's return: all must come again
_DROPS = 1.2             # s after SIGCONT in which the bridge may still drop what waited
_THAWS = 0.1             # s in which a line that thaws passes on what it held
_BEHIND_NOISE = 0.15     # s in which noise on a line without a checksum may swallow packets


class _Published(NamedTuple):
    """What was received; `values` by name of `TOPICS`."""

    values: Dict[str, List[Tuple[float, Any, float]]]     # stamp, key, arrival
    calibrating: List[Tuple[float, bool]]
    lost: List[Told]                              # the mcu link's counts in the diagnostics
    traffic: Dict[str, List[Tuple[float, Tuple]]]  # by link: good frames in, of serial_msg
    taken: List[Tuple[float, str, Tuple]]         # of the mcu: arrival, connection, frame
    opened: List[Connection]                      # of every link
    written: List[Packet]                         # by the bridge to the arduino, and when
    beats: List[float]                            # when of that a heartbeat
    offset: float


def judge(folder: str) -> List[Row]:
    """Every row of the table."""
    def path(name: str) -> str:
        return os.path.join(folder, name)

    events = read_lines(path('events.jsonl'))
    start = next(event['t'] for event in events if event['ev'] == 'begin')
    end = next((event['t'] for event in events if event['ev'] == 'finish'), events[-1]['t'])
    journals = {link: read_lines(path(link + '.journal')) for link in LINKS}
    published = _read(folder)
    frames = {link: arrivals(_with_noise(journals[link], events, link), link)
              for link in LINKS}
    calls = read_lines(path('calls.jsonl'))
    commands = read_lines(path('commands.jsonl'))
    metronome = read_lines(path('metronome.jsonl'))
    blind_replies = [frame.t for frame in frames['bus'] for made in frame.made
                     if made != frame.own]
    stopped, no_master = excuses_of_calls(events, end)
    dropped = Intervals([(began - _BEFORE_A_CUT, over + _DROPS) for began, over in stopped.pairs])
    exempt = {link: _exempt(link, events, journals[link], published, start, end) + dropped
              for link in LINKS}
    absent = {link: stretches(events, 'unplugged', 'plugged', end, link) for link in LINKS}
    frozen = stretches(events, 'frozen', 'thawed', end, 'arduino')
    held_up = stopped + frozen
    rows = check_bus(calls, journals['bus'], blind_replies, TIMEOUTS, stopped, no_master)
    number = sum(1 for call in calls if call['kind'] in TIMEOUTS)
    rows[0] = rows[0]._replace(
        note=f'of {number} lift, gimbal, raw and own calls: {outcomes(calls)}')
    rows += _of_link('bus', 'every reading of the air is one that the board measured', frames,
                     published, exempt, held_up, stopped)
    rows += _of_link('arduino', 'every undamaged packet published once, in order', frames,
                     published, exempt, held_up, stopped)
    drive = prepare(
        journals['arduino'], commands, absent['arduino'],
        _bridge_calibrates(commands, published), published.beats,
        Intervals([(one['t'], one['t'] + one['late']) for one in metronome]), held_up,
        SPEED_TIMEOUT, end)
    rows += check_motor(drive)
    came = sorted(packets_of(journals['arduino'])[0], key=lambda packet: packet.t)
    unclear = drive.closed + drive.stalled + Intervals(calibrations(journals['arduino'], end))
    # What a line held reaches the board as it thaws.
    rows.append(check_own_commands(came, commands, absent['arduino'],
                                   unclear + held_up.longer(_THAWS)))
    filled = [event['t'] for event in events if event['ev'] == 'filled'
              and event['link'] == 'arduino']
    rows.append(check_frozen_line(frozen, filled, published.written, came, unclear + stopped))
    rows += check_standstill(stopped, came, drive.speeds, [
        (entry['t'], entry['value']) for entry in commands if entry['topic'] == 'steering'],
        unclear + frozen)
    over = max([end] + [event['t'] for event in events if event['ev'] == 'bridge ended'])
    log = [line for line in _log(folder, published.offset) if line[0] <= over]
    rows += check_heartbeat(journals['arduino'], metronome, published.beats, end, held_up,
                            realtime=not any('no real-time priority for the heartbeat' in text
                                             for _t, _severity, text in log))
    rows += _of_link('mcu', 'every undamaged frame published once, in order', frames, published,
                     exempt, held_up, stopped)
    rows += check_lost_frames(heard_of(journals['mcu'], published.taken), published.lost)
    rows += _traffic(frames, published, exempt, held_up, stopped)
    rows += [_returns(link, events, journals[link], published, held_up, end) for link in LINKS]
    settled = start + min(_SETTLING, (end - start) / 3)
    rows += check_level(read_lines(path('usage.jsonl')), start, settled, end)
    rows += check_log(log)
    unread = stretches(events, 'unread', 'read again', end)
    anew = opened_anew(absent, published.opened)
    rows.append(check_unread(unread, sum(unread.holds(t) for t, _severity, _text in log), {
        link: _data_of(link, published) for link in LINKS}, {
            link: held_up + absent[link].longer(RETURN) for link in LINKS}, anew))
    rows += check_master(events, anew)
    rows += _network(folder, events, end)
    rows.append(_ending(events, journals['arduino'], end))
    return rows


# -- reading --------------------------------------------------------------------------------


def _read(folder: str) -> _Published:
    offset, messages = read_messages(os.path.join(folder, 'messages.bin'))
    by_topic: Dict[str, List] = {}
    for topic in TOPICS:
        by_topic.setdefault(topic.name.split(' ')[0], []).append(topic)
    out = _Published({topic.name: [] for topic in TOPICS}, [], [], {}, [], [], [], [], offset)
    instances = {name: get_message_class(kind)() for name, kind in RECORDED.items()}
    for t, name, data in messages:
        message = instances[name]
        message.deserialize(data)
        if name == NODE + '/imu/calibrating':
            out.calibrating.append((t, message.data))
        elif name == '/diagnostics':
            for status in message.status:
                values = {value.key: value.value for value in status.values}
                if 'frames lost' in values:
                    out.lost.append(Told(t, int(values['frames received']),
                                         int(values['frames lost'])))
        else:
            stamp = _stamp(message) - offset
            for topic in by_topic[name]:
                child = topic.name.partition(' ')[2]
                if child and message.transforms[0].child_frame_id != child:
                    continue
                key = topic.published(message)
                if key is not None:
                    out.values[topic.name].append((stamp, key, t))
    _read_traffic(folder, out)
    return out


def _read_traffic(folder: str, out: _Published) -> None:
    path = os.path.join(folder, 'traffic.bin')
    if not os.path.exists(path):
        return
    message = SerialMsg()
    seen: Set[Tuple[str, str]] = set()      # links and connections
    for t, _name, data in read_messages(path)[1]:
        message.deserialize(data)
        if (message.link, message.header.frame_id) not in seen:
            seen.add((message.link, message.header.frame_id))
            out.opened.append(Connection(message.header.stamp.to_sec() - out.offset, message.link,
                                         message.header.frame_id))
        if message.direction == SerialMsg.TX:
            if message.link == 'arduino':
                packet = Packet(message.header.stamp.to_sec() - out.offset, message.type,
                                bytes(message.data))
                out.written.append(packet)
                if packet.type == HEARTBEAT:
                    out.beats.append(packet.t)
        elif not message.error:
            frame = frame_of(message)
            out.traffic.setdefault(message.link, []).append((
                message.header.stamp.to_sec() - out.offset, frame))
            if message.link == 'mcu':
                out.taken.append((t, message.header.frame_id, frame))


def _stamp(message: genpy.Message) -> float:
    if isinstance(message, TFMessage):
        message = message.transforms[0]
    stamp = message.stamp if hasattr(message, 'stamp') else message.header.stamp
    return stamp.to_sec()


def _log(folder: str, offset: float) -> List[Tuple[float, str, str]]:
    def seconds_of(text: str) -> float:
        base, _comma, milliseconds = text.partition(',')
        wall = time.mktime(time.strptime(base, '%Y-%m-%d %H:%M:%S'))
        return wall + int(milliseconds) / 1000 - offset

    lines: List[Tuple[float, str, str]] = []
    for path in glob.glob(os.path.join(folder, 'log', 'serial_communication*.log')):
        with open(path, errors='replace') as file:
            lines += log_lines(file.read(), seconds_of)
    return sorted(lines)


def _with_noise(journal: List[Dict], events: List[Dict], link: str) -> List[Dict]:
    """What came on the line towards the bridge, from the board or not, in its order."""
    noise = [{'t': event['t'], 'ev': 'chatter', 'wire': event['data']} for event in events
             if event['ev'] == 'noise' and event['link'] == link]
    return sorted(journal + noise, key=lambda event: event['t'])


# -- when what has to hold ----------------------------------------------------------------------


def _data_of(link: str, published: _Published) -> List[float]:
    """When good frames of a link came in."""
    if link in published.traffic:
        return [t for t, _frame in published.traffic[link]]
    times: List[float] = []
    for topic in TOPICS:
        if topic.link == link:
            times += [t for t, _key, _at in published.values[topic.name]]
    return sorted(times)


def _exempt(link: str, events: List[Dict], journal: List[Dict], published: _Published,
            start: float, end: float) -> Intervals:
    """When frames may be lost: before all has begun, around a port's absence, behind noise."""
    data = _data_of(link, published)
    first = [t for topic in TOPICS if topic.link == link
             for t, _key, _at in published.values[topic.name][:1]]
    # The node's end is like a port's absence: what is on its way then is lost.
    pairs = [(0.0, max([start] + first)), (end - _BEFORE_A_CUT, float('inf'))]
    down = frozen = None
    for event in events:
        if event.get('link') != link:
            continue
        if event['ev'] == 'unplugged':
            down = event['t'] if down is None else down
        elif event['ev'] == 'plugged' and down is not None:
            at = bisect_left(data, event['t'])
            back = data[at] if at < len(data) else end
            pairs.append((down - _BEFORE_A_CUT, back + _AFTER_DATA))
            down = None
        elif event['ev'] == 'frozen':
            frozen = event['t']
        elif event['ev'] == 'thawed':
            pairs.append((frozen - _BEFORE_A_CUT, event['t'] + _AFTER_DATA))
        elif event['ev'] == 'noise' and link != 'mcu':
            pairs.append((event['t'] - 0.05, event['t'] + _BEHIND_NOISE))
    return Intervals(pairs)


def _bridge_calibrates(commands: List[Dict], published: _Published) -> Intervals:
    """From the answer to a call until the bridge says that it takes commands again."""
    pairs = []
    over = [t for t, on in published.calibrating if not on]
    for entry in commands:
        if entry['topic'] == 'calibrate' and not entry['error']:
            at = bisect_right(over, entry['t1'])
            if at < len(over):
                pairs.append((entry['t1'], over[at] - 0.1))
    return Intervals([pair for pair in pairs if pair[0] < pair[1]])


# -- rows --------------------------------------------------------------------------------------


_BLIND = {
    'bus': 'a damaged reply whose XOR still fits',
    'arduino': 'COBS packets carry no checksum: what damage leaves may be a packet of the right '
               'length with values that can be; those that cannot are dropped',
    'mcu': 'a damaged frame whose XOR still fits: one in 256 where more than one bit is wrong'}


def _of_link(link: str, says: str, frames: Dict[str, List[Arrival]], published: _Published,
             exempt: Dict[str, Intervals], held_up: Intervals, stopped: Intervals) -> List[Row]:
    topics = {}
    for topic in TOPICS:
        if topic.link == link:
            sent = expected(frames[link], topic.sent, link != 'mcu', exempt[link])
            if link == 'bus':       # a reply may be one to get_environment that came too late
                sent = [one._replace(must=False) for one in sent]
            topics[topic.name] = (sent, published.values[topic.name])
    row, blind, maybe = check_published(link, says, topics, held_up, stopped)
    if link == 'bus':
        row = row._replace(tries=sum(len(found) for _sent, found in topics.values()))
    rows = [row]
    if link == 'mcu':
        # What is published and was not sent has a wrong checksum, or is invented.
        false = [found for found in row.violations if 'no frame says so' in found[1]]
        rows[0] = row._replace(violations=[found for found in row.violations
                                           if found not in false])
        rows.append(Row(link, 'no frame that a checksum can tell is published',
                        sum(1 for frame in frames[link] if not frame.ok), false))
    rows.append(Row(link, 'values published of damage that nobody can see', blind, [], '', False,
                    _BLIND[link] if blind else ''))
    if maybe:
        rows.append(Row(link, 'values published of frames found behind or among damage', maybe, [],
                        '', False, 'their own bytes were right; a decoder may find them or not'))
    return rows


def _traffic(frames: Dict[str, List[Arrival]], published: _Published,
             exempt: Dict[str, Intervals], held_up: Intervals, stopped: Intervals) -> List[Row]:
    """serial_msg has every good frame that came in, once and in order."""
    topics: Dict[str, Tuple[List[Sent], List]] = {}
    for link in LINKS:
        if link in published.traffic:
            found = published.traffic[link]
            before = Intervals([(0.0, found[0][0])])
            sent = expected(frames[link], lambda frame: frame, True, exempt[link] + before)
            topics['serial_msg ' + link] = (sent, found)
    if not topics:
        return []
    row, _blind, _maybe = check_published('serial_msg', 'every undamaged frame in, once, in order',
                                          topics, held_up, stopped)
    return [row]


def _returns(link: str, events: List[Dict], journal: List[Dict], published: _Published,
             held_up: Intervals, end: float) -> Row:
    """Judged from when both the port and the board are back, if the board then speaks."""
    closed = closed_times(journal, end)
    dumb = fault_times(journal, ('silence', 'reset') + (('stall',) if link == 'bus' else ()), 0.5)
    dumb += held_up
    spoken = [event['t'] for event in journal if event['ev'] == 'tx' and event.get('ok')]
    plugged = [event['t'] for event in events if event['ev'] == 'plugged'
               and event['link'] == link]
    cuts = [event['t'] for event in events if event['ev'] == 'unplugged'
            and event['link'] == link]
    returns = []
    for back in plugged[1:]:
        at = bisect_right(cuts, back)
        until = cuts[at] if at < len(cuts) else end
        # The simulated board looks for its own end of the line only now and then.
        open_again = next((stop for _start, stop in closed.pairs if stop > back), back)
        if open_again < until and closed.touches(back - 0.01, back + 0.01):
            back = open_again
        if link != 'bus':
            at = bisect_left(spoken, back)
            back = spoken[at] if at < len(spoken) else until
        if not dumb.touches(back, back + 1.5):
            returns.append((back, min(until, end)))
    return check_returns(link, returns, _data_of(link, published))


def _network(folder: str, events: List[Dict], end: float) -> List[Row]:
    journal = read_lines(os.path.join(folder, 'network.journal'))
    if not journal:
        return []
    drive = prepare(journal, read_lines(os.path.join(folder, 'network_commands.jsonl')),
                    Intervals(), Intervals(), [], Intervals(), Intervals(), SPEED_TIMEOUT, end)
    return check_network(events, packets_of(journal)[0], drive.speeds, end)


def _ending(events: List[Dict], journal: List[Dict], end: float) -> Row:
    """The node that was ended at last: lived, ended in time, and SPEED 0 was its last word."""
    violations = []
    finish = next((event for event in events if event['ev'] == 'finish'), {})
    ended = next((event for event in events if event['ev'] == 'bridge ended'), {})
    if not finish.get('alive'):
        violations.append((end, 'the node had ended before'))
    if ended.get('seconds', 1e9) > ENDING:
        violations.append((end, f"it took {ended.get('seconds', 1e9):.2f} s to end"))
    last = [packet for packet in packets_of(journal)[0] if packet.t >= end - 5]
    if not last or (last[-1].type, last[-1].data) != (SPEED, b'\0\0'):
        violations.append((end, f"the last packet that the board saw is {last[-1:] or 'none'}"))
    return Row('node', 'lives to the end; SIGINT: SPEED 0 last, ends within 2 s', 1, violations,
               f"{ended.get('seconds', 0.0):.2f} s")
