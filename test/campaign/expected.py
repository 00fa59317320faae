"""What the bridge has to publish for what a board's journal says was on the wire.

The values are worked out here once more, from the protocols' own description, so that a fault
in the bridge's conversions shows. Keys are integers where the wire has integers: a published
float is turned back into what the board must have sent, and refused if it is none of that.
"""
import struct
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from math import cos, inf, isinf, isnan, pi, radians, sin, sqrt
from typing import Any, Callable, Deque, Dict, Iterable, List, NamedTuple, Optional, Tuple

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards import BOARDS, description
from serial_communication.tools.watch import topics as bridge_topics
from serial_communication.tools.watch.topics import NODE
from .align import Sent
from .packets import IMU, OWN_COMMAND, PRESS, STEERING_ANGLE, TICKS, VOLTAGE
from .records import Intervals

SENSOR_STATUS = 0x10     # TYPE of an mcu frame
_GYRO = 4000 / 65536 * pi / 180 * 25
_ACCELERATION = 8 / 65536 * 9.81
_GIVEN_UP = 0.05         # s after which a decoder drops what has begun
_TOLERANCE = 0.01        # of a step
_BESIDE = 0.02           # s that noise may have come before or after its note says
# Messages of one's own in the mix: parameters of the bridge, and what the simulated boards play.
OWN_ROWS = {
    'arduino': {'messages': {
        'pressure': {'type': 60, 'ros_type': 'sensor_msgs/FluidPressure', 'layout': '>h',
                     'fields': ['fluid_pressure'], 'scale': 0.5, 'minimum': -1000,
                     'maximum': 1000},
        'line': {'type': 61, 'ros_type': 'sensor_msgs/JointState', 'layout': '<H*',
                 'fields': ['position'], 'maximum': 4000},
        'winch': {'type': OWN_COMMAND, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt16',
                  'layout': '>H', 'fields': ['data'], 'minimum': 1}}},
    'mcu': {'messages': {
        'cliff': {'type': 0x20, 'ros_type': 'sensor_msgs/Range', 'layout': '<BH',
                  'fields': ['', 'range'], 'scale': 0.001, 'maximum': [255, 60]}}},
    'bus': {'functions': {
        'press': {'cmd2': PRESS, 'srv_type': 'serial_communication/Lift', 'timeout': 0.3,
                  'request': {'layout': '<2B', 'fields': ['direction', 'distance']}}}}}
LINKS = BOARDS
_DECODERS = {link: partial(description(link).decoder, False, OWN_ROWS[link]) for link in LINKS}
# What is recorded: topics with their types. Only the values are worked out here once more.
RECORDED = {bridge_topics.resolve(topic.name, NODE): topic.type
            for topic in [*bridge_topics.TOPICS, *(
                topic for link in LINKS
                for topic in bridge_topics.custom_topics(description(link), OWN_ROWS))]
            if topic.name not in (bridge_topics.SERIAL_MSG, '/tf_static')
            and set(topic.links) & set(LINKS) and not topic.optional}


@dataclass
class Arrival:
    """One frame of the journal, or noise, and what its bytes on the wire are to any decoder."""

    t: float
    n: int                    # its running number; 0: none
    own: Any                  # (type, command, data) that the board sent; None: noise
    ok: bool                  # the other end must find it
    copies: int
    wire: bytes               # as it went out
    end: int                  # bytes of the line up to its last one
    reopened: bool = False    # the board's port was closed or opened before it
    made: List[Any] = field(default_factory=list)   # (type, command, data) that damage made
    beside_noise: bool = False      # what noise made may have come before it
    swallowed_from: Optional[int] = None   # where a made frame begins that has the right checksum


def arrivals(journal: List[Dict], kind: str) -> List[Arrival]:
    """Each `tx` that left, with what a decoder finds in its bytes where they were damaged.

    What any decoder makes of damage may be published; and a good frame of which another with the
    right checksum was made may be missing.
    """
    frames = _decode(_place(journal, kind), kind)
    _excuse(frames, kind)
    _shift_noise(frames, kind)
    return frames


def _place(journal: List[Dict], kind: str) -> List[Arrival]:
    """What was on the line, in its order."""
    frames: List[Arrival] = []
    total, reopened = 0, False
    # A copy that came later has a place of its own, maybe behind noise or a reconnect.
    copies = {event['n'] for event in journal if event['ev'] == 'copy'}
    copied = {event['n']: event for event in journal
              if event['ev'] == 'tx' and event.get('n') in copies}
    for event in journal:
        if event['ev'] == 'port':
            reopened = True
        if event['ev'] not in ('tx', 'copy', 'chatter') or event.get('sent') is False:
            continue
        n = event.get('n', 0)
        tx = copied.get(n, event)
        times = 1 if n in copied else event.get('copies', 1)
        own, raw = _own(tx, kind) if tx['ev'] == 'tx' else (None, b'')
        wire = bytes.fromhex(tx['wire']) if 'wire' in tx else raw * times
        total += len(wire)
        frames.append(Arrival(event['t'], n, own, tx.get('ok', False), times, wire, total,
                              reopened))
        reopened = False
    return frames


def _decode(frames: List[Arrival], kind: str) -> List[Arrival]:
    """What decoders find that was not sent so; what comes of giving up has a place of its own.

    When a decoder gives up what is incomplete is a matter of milliseconds, so three are asked: a
    hasty one, one as the bridge's, and a patient one. That in the middle goes on as the board opens
    its port anew: noise may have come before, when the bridge had opened its own.
    """
    decoders = [(_DECODERS[kind](), _GIVEN_UP * patience) for patience in (0.5, 1.0, 4.0)]
    # What boards sent lately: finding that is no surprise. Not so where values repeat, and where
    # frames never wait for others.
    recent: Deque[Any] = deque(maxlen=0 if kind == 'arduino' else 50)
    found: List[Arrival] = []
    last, before = 0.0, 0      # when and where the frame before this one ended
    for one in frames:
        recent.append(one.own)
        damaged = not one.ok or any(decoder.begun for decoder, _patience in decoders)
        rest = Arrival(last, 0, None, False, 1, b'', before)
        longest = 0
        for decoder, patience in decoders:
            if one.reopened and patience != _GIVEN_UP:
                decoder.reset()
            given_up: List[Any] = []
            while decoder.pending and one.t - last > patience:
                given_up += decoder.give_up()
            for place, got in ((rest, given_up), (one, decoder.feed(one.wire))):
                surprises = [frame for frame in got if damaged and not frame.cause
                             and _of(frame) not in (recent or (one.own,))]
                place.made += [_of(frame) for frame in surprises if _of(frame) not in place.made]
                longest = max([longest] + [len(frame.raw) for frame in surprises])
        if one.own is None:
            # A decoder may begin to look anywhere in noise. Random bytes can be a frame.
            _add(one, (frame for start in range(len(one.wire))
                       for frame in _DECODERS[kind]().feed(one.wire[start:])))
        if longest:
            one.swallowed_from = one.end - longest - len(one.wire)
        found += [rest, one] if rest.made else [one]
        last, before = one.t, one.end
    return found


def _add(one: Arrival, frames: Iterable[Any]) -> None:
    """The good ones of these may come of it, too."""
    for frame in frames:
        if not frame.cause and _of(frame) not in one.made:
            one.made.append(_of(frame))


def _excuse(frames: List[Arrival], kind: str) -> None:
    """Frames that lie in one which damage made and whose checksum is right may be missing."""
    if kind == 'arduino':       # whose packets never lie in another one
        return
    for index, one in enumerate(frames):
        if one.swallowed_from is not None:
            for near in reversed(frames[:index + 1]):
                if near.end <= one.swallowed_from:
                    break
                near.ok = False


def _shift_noise(frames: List[Arrival], kind: str) -> None:
    """Noise is written beside the board: it may have come before any frame of about its time."""
    for index, noise in enumerate(frames):
        if noise.own is not None or not noise.wire:
            continue
        first = last = index
        while first > 0 and noise.t - frames[first - 1].t <= _BESIDE:
            first -= 1
        while last + 1 < len(frames) and frames[last + 1].t - noise.t <= _BESIDE:
            last += 1
        for near in range(first, last + 1):
            one, before = frames[near], frames[near - 1] if near else None
            if one.own is None:
                continue
            damage = before.wire if before and not before.ok else b''
            stream = damage + noise.wire + one.wire
            known = one.own, before.own if before else None
            one.beside_noise = True
            _add(one, (frame for start in range(len(stream) - len(one.wire))
                       for frame in _DECODERS[kind]().feed(stream[start:])
                       if _of(frame) not in known))


def _own(event: Dict, kind: str) -> Tuple[Any, bytes]:
    if kind == 'arduino':
        data = bytes.fromhex(event['data'])
        return (event['type'], 0, data), arduino.encode_raw(event['type'], data)
    raw = bytes.fromhex(event['raw'])
    if kind == 'mcu':
        return (event['type'], event['seq'], raw[4:-2]), raw
    frame = bus.ReplyDecoder().feed(raw)[0]
    return (frame.type, 0, frame.data), raw


def _of(frame) -> Tuple[int, int, bytes]:
    return frame.type, frame.command, frame.data


def expected(frames: List[Arrival], key: Callable[[Any], Any], doubled: bool,
             exempt: Intervals) -> List[Sent]:
    """What one topic has to carry.

    Args:
        key: of (type, command, data): what is published of it, or None.
        doubled: whether a frame that came twice may be published twice.
        exempt: times in which nothing has to arrive.
    """
    out = []
    for frame in frames:
        own = key(frame.own) if frame.own else None
        sent = []
        if own is not None:
            must = frame.ok and not exempt.holds(frame.t)
            sent = [Sent(frame.t, own, must, 'ok' if frame.ok else 'maybe', frame.n)] * (
                frame.copies if doubled else 1)
        made = [Sent(frame.t, other, False, 'blind', frame.n) for other in map(key, frame.made)
                if other is not None and other != own]
        if frame.beside_noise:
            out += made
        out += sent[:1] + made
        out += sent[1:]     # damage before it may have taken the first one
    return out


# -- keys of what boards send -----------------------------------------------------------------


def _unpack(frame: Tuple[int, int, bytes], type_: int, layout: str) -> Optional[Tuple]:
    if frame[0] != type_ or len(frame[2]) != struct.calcsize(layout):
        return None
    return struct.unpack(layout, frame[2])


def _imu_sent(frame) -> Any:
    values = _unpack(frame, IMU, '>11h')
    return values[:10] if values else None


def _attitude_sent(frame) -> Any:
    """In ROS's axes, of norm 1 as tf2 wants it."""
    values = _unpack(frame, IMU, '>11h')
    if not values or not any(values[:4]):
        return None
    w, x, y, z = values[:4]
    norm = sqrt(w * w + x * x + y * y + z * z)
    return _rounded(y / norm, -x / norm, z / norm, w / norm)


def _temperature_sent(frame) -> Any:
    values = _unpack(frame, IMU, '>11h')
    return values[10] if values else None


def _one(type_: int, layout: str) -> Callable[[Any], Any]:
    def key(frame) -> Any:
        values = _unpack(frame, type_, layout)
        return values[0] if values else None
    return key


def _line_sent(frame) -> Any:
    if frame[0] != 61 or len(frame[2]) % 2:
        return None
    values = struct.unpack(f'<{len(frame[2]) // 2}H', frame[2])
    return values if all(value <= 4000 for value in values) else None


def _cliff_sent(frame) -> Any:
    values = _unpack(frame, 0x20, '<BH')
    return values[1] if values and values[1] <= 60000 else None


def _pressure_sent(frame) -> Any:
    values = _unpack(frame, 60, '>h')
    return values[0] if values and -2000 <= values[0] <= 2000 else None


def _status(frame) -> Optional[Tuple]:
    """range 1, range 2, yaw, pitch, roll; angles in 0.01 degrees, the yaw restored."""
    values = _unpack(frame, SENSOR_STATUS, '<HHhhh')
    if not values:
        return None
    yaw = values[2] if values[2] >= -18000 else values[2] + 65536
    return values[:2] + (yaw,) + values[3:]


def _status_sent(frame) -> Any:
    values = _status(frame)
    if not values:
        return None
    return (frame[1], True, 0xFFFF not in values[:2]) + values


def _range_sent(index: int) -> Callable[[Any], Any]:
    def key(frame) -> Any:
        values = _status(frame)
        if not values:
            return None
        millimetres = values[index]
        if millimetres == 0xFFFF:
            return 'nan'
        return '-inf' if millimetres < 30 else 'inf' if millimetres > 2000 else millimetres
    return key


def _turn_sent(frame) -> Any:
    values = _status(frame)
    if not values:
        return None
    roll, pitch, yaw = radians(values[4] / 100), radians(values[3] / 100), radians(
        -values[2] / 100)
    cr, sr, cp, sp = cos(roll / 2), sin(roll / 2), cos(pitch / 2), sin(pitch / 2)
    cy, sy = cos(yaw / 2), sin(yaw / 2)
    return _rounded(sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
                    cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy)


def _rounded(*values: float) -> Tuple:
    return tuple(round(value, 7) + 0.0 for value in values)


def _air_sent(frame) -> Any:
    return struct.unpack('<HhH', frame[2]) if frame[0] == bus.OK and len(frame[2]) == 6 else None


# -- keys of what is published ----------------------------------------------------------------


def _steps(value: float, step: float, offset: float = 0.0) -> Any:
    """How many steps that is; the value itself if it is no whole number of them."""
    steps = (value - offset) / step
    return round(steps) if abs(steps - round(steps)) < _TOLERANCE else value


def _orientation(q) -> Tuple:
    step = 1 / 16384
    return _steps(q.w, step), _steps(-q.y, step), _steps(q.x, step), _steps(q.z, step)


def _imu_published(m) -> Any:
    w, a = m.angular_velocity, m.linear_acceleration
    return _orientation(m.orientation) + (
        _steps(-w.y, _GYRO), _steps(w.x, _GYRO), _steps(w.z, _GYRO),
        _steps(-a.y, _ACCELERATION), _steps(a.x, _ACCELERATION), _steps(a.z, _ACCELERATION))


def _hundredths(value: float) -> Any:
    return round(value * 100) if abs(value * 100 - round(value * 100)) < 0.01 else value


def _status_published(m) -> Any:
    if not m.connected:
        return None     # the board's silence; no frame
    return (m.seq, m.connected, m.valid, m.vl53_1, m.vl53_2, _hundredths(m.yaw),
            _hundredths(m.pitch), _hundredths(m.roll))


def _range_published(m) -> Any:
    if isnan(m.range):
        return 'nan'
    if isinf(m.range):
        return 'inf' if m.range == inf else '-inf'
    return round(m.range * 1000)


def _turn_published(q) -> Tuple:
    return _rounded(q.x, q.y, q.z, q.w)


class Topic(NamedTuple):
    """How one topic is held against a journal. A `name` with a space stands for a part of it."""

    link: str
    name: str
    sent: Callable[[Any], Any]
    published: Callable[[Any], Any]     # None: nothing that a frame made


TOPICS = (
    Topic('arduino', NODE + '/imu', _imu_sent, _imu_published),
    Topic('arduino', NODE + '/imu/temperature', _temperature_sent,
          lambda m: _steps(m.temperature, 1 / 340, 36.53)),
    Topic('arduino', NODE + '/voltage', _one(VOLTAGE, '<f'), lambda m: m.value),
    Topic('arduino', NODE + '/ticks', _one(TICKS, '<B'), lambda m: m.value),
    Topic('arduino', NODE + '/steering_angle', _one(STEERING_ANGLE, '<H'), lambda m: m.value),
    Topic('arduino', NODE + '/pressure', _pressure_sent,
          lambda m: _steps(m.fluid_pressure, 0.5)),
    Topic('arduino', NODE + '/line', _line_sent,
          lambda m: tuple(round(value) for value in m.position)),
    Topic('mcu', '/mcu/cliff', _cliff_sent, lambda m: _steps(m.range, 0.001)),
    Topic('arduino', '/tf imu_orientation', _attitude_sent,
          lambda m: _turn_published(m.transforms[0].transform.rotation)),
    Topic('mcu', '/mcu/status', _status_sent, _status_published),
    Topic('mcu', '/mcu/range_1', _range_sent(0), _range_published),
    Topic('mcu', '/mcu/range_2', _range_sent(1), _range_published),
    Topic('mcu', '/mcu/imu', _turn_sent, lambda m: _turn_published(m.orientation)),
    Topic('mcu', '/tf mcu_imu_orientation', _turn_sent,
          lambda m: _turn_published(m.transforms[0].transform.rotation)),
    Topic('bus', NODE + '/environment', _air_sent,
          lambda m: (m.smoke, _hundredths(m.temperature), _hundredths(m.humidity))),
    Topic('bus', NODE + '/environment/temperature', lambda frame: _part(_air_sent(frame), 1),
          lambda m: _hundredths(m.temperature)),
    Topic('bus', NODE + '/environment/humidity', lambda frame: _part(_air_sent(frame), 2),
          lambda m: _hundredths(m.relative_humidity * 100)),
)


def _part(values: Optional[Tuple], index: int) -> Any:
    return values[index] if values else None
