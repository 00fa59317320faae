"""Parameters, exactly: what those do that have other values than their defaults."""
import json
import math
import struct
import termios
import time
from typing import Any, Callable, Dict, List, Tuple

import rospy
from geometry_msgs.msg import Quaternion, QuaternionStamped
from std_msgs.msg import Bool, Header, Int16, Int16MultiArray

import by_definition as codec
from .boards import CUSTOM, MEMORY, TIMED, Reaction
from .exact_data import opened
from .exact_node import announce_levels
from .rig import PREFIX, PUBLISHED, Rig
from .robot import NODE, Published

_EFFECT = 'a parameter with another value than its default has its effect'
_CLOSE = 0.05       # by which a number may be off; relative
_FRAME_TIMEOUT = 0.2    # s
_AGE = 1.0          # s, of a command
_DOOR, _LEVEL, _LEVELS, _CAMERA = range(80, 84)     # custom messages whose values are converted
_ANGLES = 0.3, -0.2, 1.0    # rad: roll, pitch and yaw
_MESSAGES = 'arduino/messages'
_CONVERTED = {
    'door': {'type': _DOOR, 'ros_type': 'std_msgs/Bool', 'layout': '<B', 'fields': ['data']},
    'level': {'type': _LEVEL, 'ros_type': 'std_msgs/Int16', 'layout': '<h', 'fields': ['data'],
              'scale': 0.1},
    'levels': {'type': _LEVELS, 'ros_type': 'std_msgs/Int16MultiArray', 'layout': '<h*',
               'fields': ['data'], 'scale': 0.1},
    'camera': {'type': _CAMERA, 'direction': 'to_board', 'scale': 0.0001, 'layout': '<3h',
               'ros_type': 'geometry_msgs/QuaternionStamped',
               'fields': [f'quaternion.{angle}' for angle in ('roll', 'pitch', 'yaw')]}}


def _latest(rig: Rig, topic: str, send: Callable[[], None]) -> Published:
    """The message of this topic that is published for what the board sends now."""
    rig.robot.clear_records()
    rig.wait_for_data(topic, send, rig.row(_EFFECT))
    return rig.robot.published[topic][-1]


def _is_reported(rig: Rig, link: str, key: str) -> bool:
    """Whether /diagnostics has this key of the link now."""
    rig.next_report(link)       # it may be from before
    return key in rig.next_report(link)[2]


def _stdev(covariance: str, index: int) -> Callable[[Rig], float]:
    return lambda rig: math.sqrt(getattr(
        _latest(rig, '~imu', rig.car.measure).message, covariance)[index])


def _of_range(field: str) -> Callable[[Rig], Any]:
    return lambda rig: getattr(_latest(rig, 'mcu/range_1', rig.sensors.measure).message, field)


def _frame_id(topic: str) -> Callable[[Rig], str]:
    return lambda rig: _latest(rig, topic, rig.measure).message.header.frame_id[len(PREFIX):]


def _base_frame_id(rig: Rig) -> str:
    rig.wait(lambda: PREFIX + 'car_imu' in rig.robot.mounts, 'the mount of the IMU')
    return rig.robot.mounts[PREFIX + 'car_imu'][0][len(PREFIX):]


def _heartbeat_rate(rig: Rig) -> float:
    since, began = rig.car.all_beats, time.monotonic()
    rig.wait_beats(2.0)
    return (rig.car.all_beats - since) / (time.monotonic() - began)


def _command_age(rig: Rig) -> float:
    """At least the age of a command that is taken."""
    rig.robot.command('steering', 4000, time.time() - _AGE)
    rig.row(_EFFECT).wait(lambda: rig.car.packet(codec.STEERING, 4000), 'an old command', 5.0)
    return 2 * _AGE


def _is_plausible(rig: Rig) -> bool:
    """Whether a voltage of 150 V is not published."""
    packet = codec.arduino_packet(codec.VOLTAGE, struct.pack('<f', 150.0))
    return not _latest(rig, '~voltage', lambda: rig.car.send(packet))


def _retries(rig: Rig) -> int:
    rig.bus.clear_records()
    rig.bus.react = lambda request: Reaction()
    rig.robot.call('get_environment')
    rig.bus.usual()
    return rig.bus.count(codec.ENVIRONMENT) - 1


def _reply_has_cmd2(rig: Rig) -> bool:
    """Replies of the board have it."""
    return rig.robot.call('bus/request', codec.FUNCTION, MEMORY, b'\5\6').data == b'\5\6'


def _is_clockwise(rig: Rig) -> bool:
    """Whether a yaw of 90 degrees is to the right, as _attitude of robot.py has it."""
    turned = _latest(rig, 'mcu/imu', lambda: rig.sensors.send(
        rig.sensors.status(100, 100, 9000, 0, 0)))
    return turned.key[0] == 9000


def _baud(rig: Rig) -> int:
    with opened(rig.mcu_line.port) as port:
        return 57600 if termios.tcgetattr(port)[5] == termios.B57600 else 0


def _frame_timeout(rig: Rig) -> float:
    """For how long a frame waited behind a false start."""
    rig.robot.clear_records()
    rig.sensors.line.write(b'\x02\x60')
    rig.sensors.measure()
    status = rig.row(_EFFECT).wait(lambda: rig.robot.values('mcu/status'), 'the status')[0]
    return min(_FRAME_TIMEOUT, round(status.wall - status.stamp, 2))    # ROS takes some, too


def _board_time(rig: Rig) -> bool:
    rig.car.write(codec.arduino_packet(TIMED, struct.pack('<IB', 1000, 1)))
    return _is_reported(rig, 'arduino', 'clock errors')


def _announcements(rig: Rig) -> bool:
    announce_levels(rig)
    return _is_reported(rig, 'mcu', 'announced')


def _conversions(rig: Rig) -> None:
    """Values that are true or false, whole numbers, and angles of a quaternion."""
    published: List[Tuple[str, Any]] = []
    subscribers = [rospy.Subscriber(
        f'{NODE}/{name}', kind, lambda message, name: published.append((name, message.data)), name)
        for name, kind in (('door', Bool), ('level', Int16), ('levels', Int16MultiArray))]
    camera = rospy.Publisher(f'{NODE}/camera', QuaternionStamped, queue_size=1)
    rig.wait(lambda: all(each.get_num_connections() for each in (camera, *subscribers)),
             'the bridge is connected')
    for name, type_, data, wanted in (
            ('door', _DOOR, b'\0', False), ('door', _DOOR, b'\2', True),
            ('level', _LEVEL, struct.pack('<h', 126), 13), ('level', _LEVEL, b'\xF2\xFF', -1),
            ('levels', _LEVELS, struct.pack('<3h', 126, 124, -126), (13, 12, -13))):
        published.clear()
        rig.car.write(codec.arduino_packet(type_, data))
        rig.row(PUBLISHED).wait(lambda: published == [(name, wanted)],
                                f'{name} is {wanted}, not {published}')
    half = [angle / 2 for angle in _ANGLES]
    (a, b, c), (x, y, z) = map(math.cos, half), map(math.sin, half)
    turned = [x * b * c - a * y * z, a * y * c + x * b * z, a * b * z - x * y * c,
              a * b * c + x * y * z]
    camera.publish(Header(), Quaternion(*(2 * part for part in turned)))    # of any length
    rig.row('values arrive unchanged; SPEED limited, LED text checked').wait(
        lambda: struct.pack('<3h', *(round(angle * 1e4) for angle in _ANGLES)) in [
            each.data for each in rig.car.packets if each.type == _CAMERA], 'the angles')
    for each in (camera, *subscribers):
        each.unregister()


# For each the value, and what shows it.
OTHER: Dict[str, Tuple[Any, Callable[[Rig], Any]]] = {
    'base_frame_id': ('base', _base_frame_id),
    'frame_timeout': (_FRAME_TIMEOUT, _frame_timeout),
    'bus/retries': (1, _retries),
    'bus/reply_has_cmd2': (True, _reply_has_cmd2),
    'arduino/heartbeat_rate': (80.0, _heartbeat_rate),
    'arduino/command_age': (2 * _AGE, _command_age),
    'arduino/check_plausibility': (False, _is_plausible),
    'arduino/board_time': (False, _board_time),
    'arduino/imu_frame_id': ('car_imu', _frame_id('~imu')),
    'arduino/roll_pitch_stdev': (0.02, _stdev('orientation_covariance', 0)),
    'arduino/yaw_stdev': (0.2, _stdev('orientation_covariance', 8)),
    'arduino/angular_velocity_stdev': (0.03, _stdev('angular_velocity_covariance', 4)),
    'arduino/linear_acceleration_stdev': (0.5, _stdev('linear_acceleration_covariance', 4)),
    'mcu/baud': (57600, _baud),
    'mcu/announcements': (False, _announcements),
    'mcu/yaw_clockwise': (False, _is_clockwise),
    'mcu/min_range': (0.1, _of_range('min_range')),
    'mcu/max_range': (1.5, _of_range('max_range')),
    'mcu/field_of_view': (0.3, _of_range('field_of_view')),
    'mcu/range_2_frame_id': ('right', _frame_id('mcu/range_2'))}


def others(rig: Rig) -> None:
    """A bridge with other parameters and rows, and then one with the defaults again."""
    required = rig.row(_EFFECT)
    rig.end_bridge()
    try:
        rig.start({**{name: value for name, (value, _look) in OTHER.items()}, _MESSAGES: json.dumps(
            {**CUSTOM[_MESSAGES], **_CONVERTED})})
        for name, (value, look) in OTHER.items():
            found = look(rig)
            required.check(found == value or isinstance(value, float) and math.isclose(
                found, value, rel_tol=_CLOSE), f'{name}: {found}, not {value}')
        _conversions(rig)
    finally:
        rig.end_bridge()
        rig.robot.mounts.clear()
        rig.start()
