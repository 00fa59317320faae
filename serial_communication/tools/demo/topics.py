"""Every topic of the bridge, and its messages in words."""
import math
from typing import Any, Callable, NamedTuple, Tuple

LINKS = ('bus', 'arduino', 'mcu')
NODE = 'serial_communication'


def _angles(orientation: Any) -> str:
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return 'rpy %.1f %.1f %.1f deg' % (
        math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
        math.degrees(math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))),
        math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))


def _acceleration(imu: Any) -> str:
    a = imu.linear_acceleration
    return ', %.2f %.2f %.2f m/s^2' % (a.x, a.y, a.z)


def _range(message: Any) -> str:
    if math.isnan(message.range):
        return 'no reading'
    if math.isinf(message.range):
        return 'nearer than %.2f m' % message.min_range if message.range < 0 else \
            'farther than %.2f m' % message.max_range
    return '%.3f m' % message.range


def _traffic(message: Any) -> str:
    return '%s %s %s' % (message.link, 'sent' if message.direction else 'received',
                         message.error or message.text)


def _health(message: Any) -> str:
    if not message.connected:
        return 'silent for %.1f s' % message.last_frame_age_sec
    return '%s, %d CRC errors, seq %d' % (
        'valid' if message.valid else 'NOT valid', message.crc_error_count, message.seq)


def _sensor_status(message: Any) -> str:
    if not message.connected:
        return _health(message)
    return '%d and %d mm, yaw %.1f deg, %s' % (message.vl53_1, message.vl53_2, message.yaw,
                                               _health(message))


def _adc_status(message: Any) -> str:
    return '%s, %s' % (_health(message), ' '.join(
        str(getattr(message, 'adc%d' % channel)) for channel in range(6)))


def _frames(message: Any) -> str:
    return ', '.join('%s in %s' % (each.child_frame_id, each.header.frame_id)
                     for each in message.transforms)


class Topic(NamedTuple):
    """A topic that the bridge publishes: ~ stands for its private names."""

    name: str
    type: str                        # as ROS has it: package/Type
    links: Tuple[str, ...]           # it carries data if one of these links is on
    words: Callable[[Any], str]      # the last message, for a person
    optional: bool = False           # only some boards send it


TOPICS = (
    Topic('serial_msg', NODE + '/SerialMsg', LINKS, _traffic),
    Topic('~imu', 'sensor_msgs/Imu', ('arduino',),
          lambda m: _angles(m.orientation) + _acceleration(m)),
    Topic('~imu/temperature', 'sensor_msgs/Temperature', ('arduino',),
          lambda m: '%.1f degrees C' % m.temperature),
    Topic('~imu/calibrating', 'std_msgs/Bool', ('arduino',),
          lambda m: 'yes' if m.data else 'no'),
    Topic('~voltage', NODE + '/Voltage', ('arduino',), lambda m: '%.2f V' % m.value),
    Topic('~ticks', NODE + '/Ticks', ('arduino',), lambda m: '%d in 10 ms' % m.value),
    Topic('~steering_angle', NODE + '/SteeringFeedback', ('arduino',),
          lambda m: '%d of 1024' % m.value),
    Topic('~environment', NODE + '/Environment', ('bus',), lambda m: 'smoke %d, %.2f degrees C, '
          '%.2f %%' % (m.smoke, m.temperature, m.humidity)),
    Topic('~environment/temperature', 'sensor_msgs/Temperature', ('bus',),
          lambda m: '%.2f degrees C' % m.temperature),
    Topic('~environment/humidity', 'sensor_msgs/RelativeHumidity', ('bus',),
          lambda m: '%.2f %%' % (m.relative_humidity * 100)),
    Topic('mcu/status', NODE + '/McuStatus2', ('mcu',), _sensor_status),
    Topic('mcu/adc_status', NODE + '/McuStatus', ('mcu',), _adc_status, optional=True),
    Topic('mcu/imu', 'sensor_msgs/Imu', ('mcu',), lambda m: _angles(m.orientation)),
    Topic('mcu/range_1', 'sensor_msgs/Range', ('mcu',), _range),
    Topic('mcu/range_2', 'sensor_msgs/Range', ('mcu',), _range),
    Topic('/tf', 'tf2_msgs/TFMessage', ('arduino', 'mcu'), _frames),
    Topic('/tf_static', 'tf2_msgs/TFMessage', ('arduino', 'mcu'), _frames),
    Topic('/diagnostics', 'diagnostic_msgs/DiagnosticArray', LINKS,
          lambda m: '; '.join('%s: %s' % (each.name, each.message) for each in m.status)),
)
