"""The robot's side: what commands the bridge, calls it and hears it. One ROS node, this process."""
import math
import operator
import threading
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
from .boards import Sent, known, range_of, whole

NODE = '/serial_communication'
TIMEOUT, NOT_SENT = 254, 253     # status of the bus services
_GYRO = 4000 / 65536 * math.pi / 180 * 25
_ACCELERATION = 8 / 65536 * 9.81
SERVICES = {'lift': Lift, 'gimbal': Gimbal, 'bus/request': BusRequest, 'press': Lift,
            'probe': Trigger, 'get_environment': GetEnvironment, 'bus/echo': Trigger,
            'bus/sync': Trigger, 'calibrate_imu': Empty}


class Got(NamedTuple):
    """One message that was published."""

    wall: float      # when it arrived, by time.time()
    stamp: float     # of its header; without one: 0
    key: Any         # as the boards have it
    message: Any


class Told(NamedTuple):
    """What a caller was told."""

    success: bool
    status: Optional[int]    # None: the service has none
    seconds: float
    message: str
    data: bytes = b''


# -- published values as the numbers on the wire -------------------------------------------------


def _imu(message: Imu) -> Tuple:
    q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
    return tuple(whole(each) for each in (
        q.w * 16384, -q.y * 16384, q.x * 16384, q.z * 16384, -w.y / _GYRO, w.x / _GYRO, w.z / _GYRO,
        -a.y / _ACCELERATION, a.x / _ACCELERATION, a.z / _ACCELERATION))


def _hundredths(value: float) -> Any:
    return None if math.isnan(value) else whole(value * 100)


def _status(message: McuStatus2) -> Any:
    angles = tuple(map(_hundredths, (message.yaw, message.pitch, message.roll)))
    return (message.seq, message.vl53_1, message.vl53_2,
            known(angles)) if message.connected else None


def _range(message: Range) -> Any:
    if math.isinf(message.range):
        return 'far' if message.range > 0 else 'near'
    return range_of(0xFFFF) if math.isnan(message.range) else round(message.range * 1000, 3)


Key = Callable[[Any], Any]
_VALUE, _DATA = operator.attrgetter('value'), operator.attrgetter('data')
TOPICS: Dict[str, Tuple[Any, Key]] = {
    '~ticks': (Ticks, _VALUE), '~steering_angle': (SteeringFeedback, _VALUE),
    '~voltage': (Voltage, lambda message: whole(message.value * 1000)),
    '~counter': (UInt32, _DATA), '~imu': (Imu, _imu),
    '~imu/temperature': (Temperature, lambda m: whole((m.temperature - 36.53) * 340)),
    'mcu/status': (McuStatus2, _status), 'mcu/cliff': (UInt32, _DATA),
    'mcu/range_1': (Range, _range), 'mcu/range_2': (Range, _range),
    '~environment': (Environment, lambda m: (m.smoke, _hundredths(m.temperature),
                                             _hundredths(m.humidity))),
    '~depth': (UInt32, _DATA), '~height': (UInt32, _DATA)}
COMMANDS = {'speed': SpeedPWMCommand, 'steering': SteeringPWMCommand, 'led': String,
            'winch': UInt16}


class Robot:
    """Has a publisher of each command, a subscriber of everything, and callers."""

    def __init__(self) -> None:
        rospy.init_node('campaign', anonymous=True, disable_signals=True, disable_rosout=True,
                        log_level=rospy.FATAL)
        self.got: Dict[str, List[Got]] = {topic: [] for topic in TOPICS}
        self.diagnostics: Dict[str, Tuple[float, int, str, Dict[str, str]]] = {}
        self.on_message: Callable[[str, Got], None] = self.keep
        self.on_frame: Callable[[SerialMsg], None] = lambda message: None
        self._pool = ThreadPoolExecutor(32)
        self._lock = threading.Lock()
        self._publishers = {
            name: rospy.Publisher(f'{NODE}/{name}', kind, queue_size=100, tcp_nodelay=True)
            for name, kind in COMMANDS.items()}
        self._subscribers = {
            topic: rospy.Subscriber(topic.replace('~', NODE + '/'), kind, self._take, (topic, key),
                                    tcp_nodelay=True, buff_size=1 << 20)
            for topic, (kind, key) in TOPICS.items()}
        rospy.Subscriber('/diagnostics', DiagnosticArray, self._diagnosed)
        self._traffic: Optional[rospy.Subscriber] = None

    def forget(self) -> None:
        for messages in self.got.values():
            messages.clear()

    def has(self, sent: Sent) -> bool:
        return any(got.key == sent.key and (not got.stamp or got.stamp >= sent.wall)
                   for got in list(self.got[sent.topic]))

    def keep(self, topic: str, got: Got) -> None:
        self.got[topic].append(got)

    def _take(self, message: Any, what: Tuple[str, Key]) -> None:
        wall, (topic, key) = time.time(), what
        stamp = (message.stamp if hasattr(message, 'stamp') else message.header.stamp
                 if hasattr(message, 'header') else None)
        self.on_message(topic, Got(wall, stamp.to_sec() if stamp else 0.0, key(message), message))

    def _diagnosed(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name.split(': ')[-1].split(' ')[0]] = (
                time.monotonic(), int(status.level), status.message,
                {value.key: value.value for value in status.values})

    def listen_to_traffic(self, wanted: bool = True) -> None:
        if wanted:
            self._traffic = rospy.Subscriber('/serial_msg', SerialMsg,
                                             lambda message: self.on_frame(message),
                                             tcp_nodelay=True, buff_size=1 << 20)
        elif self._traffic:
            self._traffic.unregister()

    def command(self, name: str, value: Any, stamp: float = 0.0) -> None:
        """Publish one; `stamp` is ROS time."""
        message = COMMANDS[name]()
        if stamp:
            message.header.stamp = rospy.Time.from_sec(stamp)
        if hasattr(message, 'value'):
            message.value = value
        else:
            message.data = value
        self._publishers[name].publish(message)

    def connected(self, topics: Iterable[str]) -> bool:
        """Whether the bridge takes commands, and what it publishes on these comes here."""
        return all(one.get_num_connections() for one in (
            *self._publishers.values(), *(self._subscribers[topic] for topic in topics)))

    def register_again(self) -> None:
        """With a new master: rospy does it once only."""
        manager = rospy.topics.get_topic_manager()
        for kind, topics in ((Registration.PUB, manager.get_publications()),
                             (Registration.SUB, manager.get_subscriptions())):
            for name, type_ in topics:
                get_registration_listeners().notify_added(name, type_, kind)

    def call(self, service: str, *arguments: Any) -> Told:
        """Call it; what the caller is told. A service error is no success."""
        began = time.monotonic()
        try:
            answer = rospy.ServiceProxy(f'{NODE}/{service}', SERVICES[service])(*arguments)
        except (rospy.ServiceException, rospy.ROSException, OSError) as error:
            return Told(False, None, time.monotonic() - began, f'{type(error).__name__}: {error}')
        return Told(getattr(answer, 'success', True), getattr(answer, 'status', None),
                    time.monotonic() - began, getattr(answer, 'message', ''),
                    bytes(getattr(answer, 'data', b'')))

    def calling(self, service: str, *arguments: Any) -> 'Future[Told]':
        return self._pool.submit(self.call, service, *arguments)
