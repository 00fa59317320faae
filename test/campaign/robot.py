"""The robot's side: publishes commands, subscribes and calls. One ROS node in this process."""
import math
import operator
import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Tuple

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from rospy.impl.registration import Registration, get_registration_listeners
from sensor_msgs.msg import Imu, Range, Temperature
from std_msgs.msg import String, UInt16, UInt32
from std_srvs.srv import Empty, Trigger

from serial_communication.msg import (Environment, McuStatus2, SerialMsg, SpeedPWMCommand,
                                      SteeringFeedback, SteeringPWMCommand, Ticks, Voltage)
from serial_communication.srv import BusRequest, GetEnvironment, Gimbal, Lift
from .boards import Sent, angles_key, range_key, wire_number

NODE = '/serial_communication'
TIMEOUT, NOT_SENT = 254, 253     # status of the bus services
_GYRO = 4000 / 65536 * math.pi / 180 * 25
_ACCELERATION = 8 / 65536 * 9.81
SERVICES = {'lift': Lift, 'gimbal': Gimbal, 'bus/request': BusRequest, 'press': Lift,
            'probe': Trigger, 'get_environment': GetEnvironment, 'bus/echo': Trigger,
            'bus/sync': Trigger, 'calibrate_imu': Empty}


class Published(NamedTuple):
    """A message that the bridge published."""

    wall: float      # when it arrived, by time.time()
    stamp: float     # of its header; 0 if it has none
    key: Any         # its value in the numbers of the wire, as boards.py has it
    message: Any


class Outcome(NamedTuple):
    """What a call returned."""

    success: bool
    status: Optional[int]    # None: the service has none
    seconds: float
    message: str
    data: bytes = b''


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
    return (message.seq, message.vl53_1, message.vl53_2,
            angles_key(angles)) if message.connected else None


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
    '~environment': (Environment, lambda m: (m.smoke, _hundredths(m.temperature),
                                             _hundredths(m.humidity))),
    '~depth': (UInt32, _DATA), '~height': (UInt32, _DATA)}
COMMANDS = {'speed': SpeedPWMCommand, 'steering': SteeringPWMCommand, 'led': String,
            'winch': UInt16}


class Robot:
    """Has a publisher of each command, a subscriber of each topic, and callers."""

    def __init__(self) -> None:
        rospy.init_node('campaign', anonymous=True, disable_signals=True, disable_rosout=True,
                        log_level=rospy.FATAL)
        self.published: Dict[str, List[Published]] = {topic: [] for topic in TOPICS}
        self.reports: Dict[str, Tuple[float, int, str, Dict[str, str]]] = {}    # of /diagnostics
        self.on_message: Callable[[str, Published], None] = self.keep
        self._pool = ThreadPoolExecutor(32)
        self._publishers = {
            name: rospy.Publisher(f'{NODE}/{name}', kind, queue_size=100, tcp_nodelay=True)
            for name, kind in COMMANDS.items()}
        self._subscribers = {
            topic: rospy.Subscriber(topic.replace('~', NODE + '/'), kind, self._receive,
                                    (topic, to_key), tcp_nodelay=True)
            for topic, (kind, to_key) in TOPICS.items()}
        rospy.Subscriber('/diagnostics', DiagnosticArray, self._receive_report)

    def clear_records(self) -> None:
        for messages in self.published.values():
            messages.clear()

    def has(self, sent: Sent) -> bool:
        return any(each.key == sent.key and (not each.stamp or each.stamp >= sent.wall)
                   for each in list(self.published[sent.topic]))

    def keep(self, topic: str, message: Published) -> None:
        self.published[topic].append(message)

    def _receive(self, message: Any, topic_and_key: Tuple[str, ToKey]) -> None:
        wall, (topic, to_key) = time.time(), topic_and_key
        stamp = (message.stamp if hasattr(message, 'stamp') else message.header.stamp
                 if hasattr(message, 'header') else None)
        self.on_message(topic, Published(wall, stamp.to_sec() if stamp else 0.0, to_key(message),
                                         message))

    def _receive_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.reports[status.name.split(': ')[-1].split(' ')[0]] = (
                time.monotonic(), int(status.level), status.message,
                {value.key: value.value for value in status.values})

    def subscribe_to_traffic(self, on_frame: Callable[[SerialMsg], None]) -> rospy.Subscriber:
        return rospy.Subscriber('/serial_msg', SerialMsg, on_frame, tcp_nodelay=True)

    def command(self, name: str, value: Any, stamp: float = 0.0) -> None:
        """Publish a command; `stamp` is ROS time."""
        message = COMMANDS[name]()
        if stamp:
            message.header.stamp = rospy.Time.from_sec(stamp)
        if hasattr(message, 'value'):
            message.value = value
        else:
            message.data = value
        self._publishers[name].publish(message)

    def connected(self, topics: Iterable[str]) -> bool:
        """Whether the bridge receives all commands, and this node receives these topics."""
        return all(each.get_num_connections() for each in (
            *self._publishers.values(), *(self._subscribers[topic] for topic in topics)))

    def register_again(self) -> None:
        """Register with a new master; rospy itself registers only once."""
        manager = rospy.topics.get_topic_manager()
        for kind, topics in ((Registration.PUB, manager.get_publications()),
                             (Registration.SUB, manager.get_subscriptions())):
            for name, type_ in topics:
                get_registration_listeners().notify_added(name, type_, kind)

    def call(self, service: str, *arguments: Any) -> Outcome:
        """Call a service. A service error is an outcome without success."""
        began = time.monotonic()
        try:
            response = rospy.ServiceProxy(f'{NODE}/{service}', SERVICES[service])(*arguments)
        except (rospy.ServiceException, rospy.ROSException, OSError) as error:
            return Outcome(False, None, time.monotonic() - began, repr(error))
        return Outcome(getattr(response, 'success', True), getattr(response, 'status', None),
                       time.monotonic() - began, getattr(response, 'message', ''),
                       bytes(getattr(response, 'data', b'')))

    def start_call(self, service: str, *arguments: Any) -> 'Future[Outcome]':
        return self._pool.submit(self.call, service, *arguments)
