"""The robot's side: publishes speeds, subscribes and calls. One ROS node in this process."""
import math
import operator
import time
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

import rospy
from sensor_msgs.msg import Imu, Range, RelativeHumidity, Temperature
from std_msgs.msg import Float32MultiArray, UInt32

from serial_communication.msg import (Environment, McuStatus, McuStatus2, SerialMsg,
                                      SpeedPWMCommand, SteeringFeedback, Ticks, Voltage)
from serial_communication.srv import BusRequest
from .boards import range_key, wire_number
from .requirements import Requirement

NODE = '/serial_communication'
_OF_POLLS = f'{NODE}/depth', f'{NODE}/height'
_TIMEOUT = 254           # status of the bus services
_GYRO = 4000 / 65536 * math.pi / 180 * 25      # rad/s
_ACCELERATION = 8 / 65536 * 9.81


class Outcome(NamedTuple):
    """What a call returned."""

    success: bool
    status: Optional[int]    # None: a service error
    data: bytes = b''

    def check(self, row: Callable[[str], Requirement], executed: int, text: str) -> None:
        """Check it against how often the board has executed the request."""
        if self.success:
            row('outcome done: executed exactly once').check(executed == 1, text)
        elif self.status == _TIMEOUT:
            row('outcome not known: executed at most once').check(executed <= 1, text)
        else:
            row('outcome refused or not sent: not executed').check(not executed, text)


# -- published values as the numbers on the wire -------------------------------------------------


def _imu(message: Imu) -> Tuple:
    q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
    return tuple(wire_number(each) for each in (
        q.w * 16384, -q.y * 16384, q.x * 16384, q.z * 16384, -w.y / _GYRO, w.x / _GYRO, w.z / _GYRO,
        -a.y / _ACCELERATION, a.x / _ACCELERATION, a.z / _ACCELERATION))


def _hundredths(value: float) -> Any:
    return None if math.isnan(value) else wire_number(value * 100)


def _status(message: McuStatus2) -> Any:
    angles = tuple(map(_hundredths, (message.yaw, message.pitch, message.roll)))
    return (message.seq, message.valid, message.vl53_1, message.vl53_2, angles) \
        if message.connected else None


def _adc(message: McuStatus) -> Any:
    return (message.seq, *(getattr(message, f'adc{n}') for n in range(6))) \
        if message.connected else None


def _attitude(q: Any) -> Tuple:
    """Heading, pitch and roll in hundredths of a degree."""
    if math.isnan(q.w + q.x + q.y + q.z):
        return ('not known',)
    roll = math.atan2(2 * (q.w * q.x + q.y * q.z), 1 - 2 * (q.x * q.x + q.y * q.y))
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (q.w * q.y - q.z * q.x))))
    heading, *others = (round(math.degrees(angle) * 100) for angle in (-yaw, pitch, roll))
    return (heading % 36000, *others)


def _environment(message: Environment) -> Tuple:
    return message.smoke, _hundredths(message.temperature), _hundredths(message.humidity)


def _range(message: Range) -> Any:
    if math.isinf(message.range):
        return 'far' if message.range > 0 else 'near'
    return range_key(0xFFFF) if math.isnan(message.range) else round(message.range * 1000, 3)


ToKey = Callable[[Any], Any]
_VALUE, _DATA = operator.attrgetter('value'), operator.attrgetter('data')
TOPICS: Dict[str, Tuple[Any, ToKey]] = {
    '~ticks': (Ticks, _VALUE), '~steering_angle': (SteeringFeedback, _VALUE),
    '~voltage': (Voltage, lambda message: wire_number(message.value * 1000)),
    '~counter': (UInt32, _DATA), '~imu': (Imu, _imu),
    '~imu/temperature': (Temperature, lambda m: wire_number((m.temperature - 36.53) * 340)),
    'mcu/status': (McuStatus2, _status), 'mcu/cliff': (UInt32, _DATA),
    'mcu/range_1': (Range, _range), 'mcu/range_2': (Range, _range),
    '~environment': (Environment, _environment),
    '~environment/temperature': (Temperature, lambda m: _hundredths(m.temperature)),
    '~environment/humidity': (RelativeHumidity, lambda m: _hundredths(m.relative_humidity * 100)),
    'mcu/adc_status': (McuStatus, _adc),
    'mcu/imu': (Imu, lambda m: _attitude(m.orientation)),
    '~scan': (Float32MultiArray, lambda m: tuple(
        None if math.isnan(each) else wire_number(each * 2) for each in m.data)),
    '~depth': (UInt32, _DATA), '~height': (UInt32, _DATA)}


class Robot:
    """Has a publisher of speeds, a subscriber of each topic, and callers."""

    def __init__(self) -> None:
        rospy.init_node('campaign', anonymous=True, disable_signals=True, disable_rosout=True,
                        log_level=rospy.FATAL)
        self.on_value: Callable[[str, Any], None] = lambda topic, key: None
        self._speeds = rospy.Publisher(f'{NODE}/speed', SpeedPWMCommand, queue_size=100,
                                       tcp_nodelay=True)
        self._subscribers = [
            rospy.Subscriber(topic.replace('~', NODE + '/'), kind, self._receive, (topic, to_key),
                             tcp_nodelay=True)
            for topic, (kind, to_key) in TOPICS.items()]

    def _receive(self, message: Any, topic_and_key: Tuple[str, ToKey]) -> None:
        topic, to_key = topic_and_key
        self.on_value(topic, to_key(message))

    @staticmethod
    def subscribe_to_traffic() -> rospy.Subscriber:
        return rospy.Subscriber('/serial_msg', SerialMsg, lambda message: None, tcp_nodelay=True)

    def drive(self, speed: int) -> None:
        message = SpeedPWMCommand(value=speed)
        message.header.stamp = rospy.Time.from_sec(time.time())
        self._speeds.publish(message)

    @property
    def connected(self) -> bool:
        """Whether the bridge receives speeds, and this node all topics but those of polls."""
        return all(each.get_num_connections() for each in (
            self._speeds, *self._subscribers) if each.name not in _OF_POLLS)

    @property
    def topics(self) -> List[str]:
        """Those that the bridge publishes now."""
        return [each.name for each in self._subscribers if each.get_num_connections()]

    @staticmethod
    def request(*arguments: Any) -> Outcome:
        """Call bus/request. A service error is an outcome without success."""
        try:
            response = rospy.ServiceProxy(f'{NODE}/bus/request', BusRequest)(*arguments)
        except (rospy.ServiceException, rospy.ROSException, OSError):
            return Outcome(False, None)
        return Outcome(response.success, response.status, bytes(response.data))
