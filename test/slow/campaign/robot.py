"""The robot's side: publishes commands, subscribes and calls. One ROS node in this process."""
import contextlib
import math
import operator
import time
from collections import defaultdict, deque
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import (Any, Callable, Deque, Dict, Iterator, List, NamedTuple, Optional, Tuple,
                    Union)

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rospy.impl.registration import Registration, get_registration_listeners
from sensor_msgs.msg import Imu, MagneticField, Range, RelativeHumidity, Temperature
from std_msgs.msg import Bool, Float32MultiArray, String, UInt8MultiArray, UInt16, UInt32
from std_srvs.srv import Empty, Trigger
from tf2_msgs.msg import TFMessage

from serial_communication.msg import (Environment, McuStatus, McuStatus2, SerialMsg,
                                      SpeedPWMCommand, SteeringFeedback, SteeringPWMCommand, Ticks,
                                      Voltage)
from serial_communication.srv import BusRequest, GetEnvironment, Gimbal, Lift, Release
from .boards import HEATER_OFFSET, HEATER_SCALE, Sent, range_key, unit_key, wire_number
from .requirements import MAX_WAIT, Requirement

NODE = '/serial_communication'
_OF_POLLS = f'{NODE}/depth', f'{NODE}/height'
TIMEOUT, NOT_SENT = 254, 253     # status of the bus services
PREFIX = 'r_'           # of all frames: a parameter
GYRO = 2000 / 65536 * math.pi / 180 * 25       # rad/s: a parameter, half of its default
_ACCELERATION = 8 / 65536 * 9.81
SERVICES = {'lift': Lift, 'gimbal': Gimbal, 'bus/request': BusRequest, 'press': Lift,
            'probe': Trigger, 'quick': Trigger, 'get_environment': GetEnvironment,
            'bus/echo': Trigger, 'bus/sync': Trigger, 'calibrate_imu': Empty, 'halt': Trigger,
            'pump': Trigger, 'swap': BusRequest, 'rest': Empty,
            **{f'{link}/{name}': kind for link in ('bus', 'arduino', 'mcu')
               for name, kind in (('release', Release), ('reset', Trigger))}}


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
    message: str
    data: bytes = b''
    error_code: int = 0
    reading: Any = None      # of get_environment, as it is published
    header: Any = None       # likewise
    began: float = 0.0
    ended: float = 0.0

    @property
    def name(self) -> str:
        status = {TIMEOUT: 'not known', NOT_SENT: 'not sent'}.get(self.status, 'refused')
        return 'done' if self.success else status

    def check(self, row: Callable[[str], Requirement], executed: int, text: str) -> None:
        """Check it against how often the board has executed the request."""
        requirement, holds = {
            'done': ('outcome done: executed exactly once', executed == 1),
            'not known': ('outcome not known: executed at most once', executed <= 1),
        }.get(self.name, ('outcome refused or not sent: not executed', not executed))
        row(requirement).check(holds, text)


# -- published values as the numbers on the wire -------------------------------------------------


def _imu(message: Imu) -> Tuple:
    q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
    return tuple(wire_number(each) for each in (
        q.w * 16384, -q.y * 16384, q.x * 16384, q.z * 16384, -w.y / GYRO, w.x / GYRO, w.z / GYRO,
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


def _range(message: Range) -> Any:
    if math.isinf(message.range):
        return 'far' if message.range > 0 else 'near'
    return range_key(0xFFFF) if math.isnan(message.range) else round(message.range * 1000, 3)


def _environment(message: Environment) -> Tuple:
    return message.smoke, _hundredths(message.temperature), _hundredths(message.humidity)


def _field(message: MagneticField) -> Tuple:
    x, y, z = (getattr(message.magnetic_field, axis) for axis in 'xyz')
    return (wire_number((x - 10) * 2), None if math.isnan(y) else wire_number(y * 4),
            wire_number(z))


def _place(message: Odometry) -> Tuple:
    at, q = message.pose.pose.position, message.pose.pose.orientation
    return wire_number(at.x * 1000), wire_number(at.y * 1000), _yaw(q)


def _yaw(q: Any) -> Any:
    return wire_number(2e4 * math.atan2(q.z, q.w))


ToKey = Callable[[Any], Any]
_VALUE, _DATA = operator.attrgetter('value'), operator.attrgetter('data')
TOPICS: Dict[str, Tuple[Any, ToKey]] = {
    '~ticks': (Ticks, _VALUE), '~steering_angle': (SteeringFeedback, _VALUE),
    '~voltage': (Voltage, lambda message: wire_number(message.value * 1000)),
    '~counter': (UInt32, _DATA), '~imu': (Imu, _imu), '~field': (MagneticField, _field),
    '~timed': (Temperature, operator.attrgetter('temperature')),
    '~imu/temperature': (Temperature, lambda m: wire_number((m.temperature - 36.53) * 340)),
    'mcu/status': (McuStatus2, _status), 'mcu/cliff': (UInt32, _DATA),
    'mcu/range_1': (Range, _range), 'mcu/range_2': (Range, _range),
    '~environment': (Environment, _environment),
    '~environment/temperature': (Temperature, lambda m: _hundredths(m.temperature)),
    '~environment/humidity': (RelativeHumidity, lambda m: _hundredths(m.relative_humidity * 100)),
    '~imu/calibrating': (Bool, lambda m: None),      # no measurement
    '~blob': (UInt8MultiArray, lambda m: bytes(m.data)), '~note': (String, _DATA),
    'mcu/adc_status': (McuStatus, _adc),
    'mcu/imu': (Imu, lambda m: _attitude(m.orientation)),
    'tf/imu_orientation': (None, lambda q: unit_key((q.w, -q.y, q.x, q.z))),
    'tf/mcu_imu_orientation': (None, _attitude),
    '~place': (Odometry, _place), 'tf/place': (None, _yaw),
    '~scan': (Float32MultiArray, lambda m: tuple(
        None if math.isnan(each) else wire_number(each * 2) for each in m.data)),
    '~depth': (UInt32, _DATA), '~height': (UInt32, _DATA)}


def _matrix(*deviations: float) -> Tuple[float, ...]:
    """The diagonal matrix of these variances."""
    return tuple(each ** 2 if row == column else 0.0 for row, each in enumerate(deviations)
                 for column in range(3))


_ATTITUDE = _matrix(math.radians(1), math.radians(1), math.radians(5))
_UNKNOWN = (-1.0, *[0.0] * 8)
_COVARIANCES = operator.attrgetter('orientation_covariance', 'angular_velocity_covariance',
                                   'linear_acceleration_covariance')
_LIMITS = (operator.attrgetter('radiation_type', 'field_of_view', 'min_range', 'max_range'),
           (Range.INFRARED, math.radians(25), 0.03, 2.0))
_NOWHERE = (operator.attrgetter('transform.translation.x', 'transform.translation.y',
                                'transform.translation.z'), (0.0, 0.0, 0.0))
# Fields that are the same in every message.
SAME: Dict[str, Tuple[Callable[[Any], Any], Tuple]] = {
    '~imu': (_COVARIANCES, (_ATTITUDE, _matrix(*[math.radians(0.05)] * 3),
                            _matrix(*[400e-6 * 9.807] * 3))),
    'mcu/imu': (_COVARIANCES, (_ATTITUDE, _UNKNOWN, _UNKNOWN)),
    '~field': (operator.attrgetter('magnetic_field_covariance'),
               _matrix(1.0, math.sqrt(2.0), math.sqrt(3.0))),
    'mcu/range_1': _LIMITS, 'mcu/range_2': _LIMITS, 'tf/imu_orientation': _NOWHERE,
    'tf/mcu_imu_orientation': _NOWHERE,
    'mcu/status': (lambda m: (m.last_frame_age_sec < 1.0,), (True,)),
    'mcu/adc_status': (lambda m: (m.valid, m.last_frame_age_sec < 1.0), (True, True))}


def _flat(value: Any) -> List[float]:
    return [each for part in value for each in _flat(part)] if isinstance(
        value, (tuple, list)) else [value]


def other_fields(topic: str, message: Any) -> str:
    """What is wrong with the fields that are the same in every message; '' if nothing is."""
    fields, wanted = SAME.get(topic, (lambda m: (), ()))
    found, expected = _flat(fields(message)), _flat(wanted)
    holds = len(found) == len(expected) and all(
        math.isclose(one, other, rel_tol=1e-5, abs_tol=1e-12)
        for one, other in zip(found, expected))
    return '' if holds else f'{topic} has {found}, not {wanted}'


FRAMES = {topic: PREFIX + frame for topic, frame in {
    '~imu': 'imu', '~field': 'magnet', '~imu/temperature': 'imu', 'mcu/imu': 'mcu_imu',
    'tf/imu_orientation': 'imu', 'tf/mcu_imu_orientation': 'mcu_imu', '~place': 'odom',
    'tf/place': 'odom', 'mcu/range_1': 'range_1', 'mcu/range_2': 'range_2',
    '~environment': 'base_link', '~environment/temperature': 'base_link',
    '~environment/humidity': 'base_link'}.items()}
# The commands: class of the message, and its field.
COMMANDS: Dict[str, Tuple[Any, str]] = {
    'speed': (SpeedPWMCommand, 'value'), 'steering': (SteeringPWMCommand, 'value'),
    'led': (String, 'data'), 'winch': (UInt16, 'data'), 'heater': (Temperature, 'temperature')}
WITH_STAMP = tuple(name for name, (kind, _field) in COMMANDS.items() if kind._has_header)


def command_of(name: str, value: Any, stamp: float = 0.0) -> Any:
    """The message of this command; an LED command has the number as its text."""
    kind, field = COMMANDS[name]
    message = kind()
    if stamp:
        message.header.stamp = rospy.Time.from_sec(stamp)
    if name == 'led' and isinstance(value, int):
        value = f'n{value}'
    elif name == 'heater':
        value = value * HEATER_SCALE + HEATER_OFFSET
    setattr(message, field, value)
    return message


def publishers(latch: bool = False) -> Dict[str, rospy.Publisher]:
    """A publisher of each command."""
    return {name: rospy.Publisher(f'{NODE}/{name}', kind, queue_size=100, tcp_nodelay=True,
                                  latch=latch) for name, (kind, _field) in COMMANDS.items()}


class Robot:
    """Has a publisher of each command, a subscriber of each topic, and callers."""

    def __init__(self) -> None:
        rospy.init_node('campaign', anonymous=True, disable_signals=True, disable_rosout=True,
                        log_level=rospy.FATAL)
        self.published: Dict[str, List[Published]] = {topic: [] for topic in TOPICS}
        # The latest of each link in /diagnostics: when it arrived, level, message and values.
        self.reports: Dict[str, Deque[Tuple[float, int, str, Dict[str, str]]]] = defaultdict(
            lambda: deque(maxlen=20))
        self.report_times: List[float] = []     # of those of the sensor board
        self.mounts: Dict[str, Tuple] = {}      # in /tf_static: parent, place and rotation by frame
        self.on_message: Callable[[str, Published], None] = self.keep
        self._pool = ThreadPoolExecutor(32)
        self._publishers = publishers()
        self._subscribers = self._subscribe()

    def _subscribe(self) -> List[rospy.Subscriber]:
        return [
            *(self._subscribe_to(topic) for topic, (kind, _to_key) in TOPICS.items() if kind),
            self._subscribe_to('tf/'),
            rospy.Subscriber('/tf_static', TFMessage, self._receive_mounts, tcp_nodelay=True),
            rospy.Subscriber('/diagnostics', DiagnosticArray, self._receive_report)]

    def _subscribe_to(self, topic: str) -> rospy.Subscriber:
        if topic.startswith('tf/'):
            return rospy.Subscriber('/tf', TFMessage, self._receive_transforms, tcp_nodelay=True)
        kind, to_key = TOPICS[topic]
        return rospy.Subscriber(topic.replace('~', NODE + '/'), kind, self._receive,
                                (topic, to_key), tcp_nodelay=True)

    @contextlib.contextmanager
    def only(self, topic: str) -> Iterator[None]:
        """Subscribe to nothing but this topic meanwhile."""
        for each in self._subscribers:
            each.unregister()
        self._subscribers = [self._subscribe_to(topic)]
        try:
            yield
        finally:
            self._subscribers[0].unregister()
            self._subscribers = self._subscribe()

    def clear_records(self) -> None:
        for messages in self.published.values():
            messages.clear()
        self.report_times.clear()

    def has(self, sent: Sent) -> bool:
        return any(each.key == sent.key and (not each.stamp or each.stamp >= sent.wall)
                   for each in list(self.published[sent.topic]))

    def values(self, topic: str) -> List[Published]:
        """What was published, without the reports of a silent board."""
        return [each for each in list(self.published[topic]) if each.key is not None]

    def keep(self, topic: str, message: Published) -> None:
        self.published[topic].append(message)

    def _receive(self, message: Any, topic_and_key: Tuple[str, ToKey]) -> None:
        wall, (topic, to_key) = time.time(), topic_and_key
        stamp = (message.stamp if hasattr(message, 'stamp') else message.header.stamp
                 if hasattr(message, 'header') else None)
        seconds = stamp.to_sec() if stamp else 0.0
        self.on_message(topic, Published(wall, seconds, to_key(message), message))

    def _receive_transforms(self, message: TFMessage) -> None:
        for each in message.transforms:
            topic = 'tf/' + each.child_frame_id[len(PREFIX):]
            rotation = each.transform.rotation
            self.on_message(topic, Published(time.time(), each.header.stamp.to_sec(),
                                             TOPICS[topic][1](rotation), each))

    def _receive_mounts(self, message: TFMessage) -> None:
        for each in message.transforms:
            at, turn = each.transform.translation, each.transform.rotation
            self.mounts[each.child_frame_id] = (each.header.frame_id, *(round(
                number, 6) for number in (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)))

    def _receive_report(self, message: DiagnosticArray) -> None:
        if 'mcu' in message.status[0].name:
            self.report_times.append(time.monotonic())
        for status in message.status:
            self.reports[status.name.split(': ')[-1].split(' ')[0]].append((
                time.monotonic(), int(status.level), status.message,
                {'hardware id': status.hardware_id,
                 **{value.key: value.value for value in status.values}}))

    def subscribe_to_traffic(self, on_frame: Callable[[SerialMsg], None]) -> rospy.Subscriber:
        return rospy.Subscriber('/serial_msg', SerialMsg, on_frame, tcp_nodelay=True)

    def command(self, name: str, value: Any, stamp: float = 0.0) -> None:
        """Publish a command; `stamp` is ROS time."""
        self._publishers[name].publish(command_of(name, value, stamp))

    @property
    def connected(self) -> bool:
        """Whether the bridge receives all commands, and this node all topics but those of polls."""
        return all(each.get_num_connections() for each in (
            *self._publishers.values(), *self._subscribers) if each.name not in _OF_POLLS)

    @property
    def topics(self) -> List[str]:
        """Those that the bridge publishes now."""
        return [each.name for each in self._subscribers if each.get_num_connections()]

    def register_again(self) -> None:
        """Register with a new master; rospy itself registers only once."""
        manager = rospy.topics.get_topic_manager()
        for kind, topics in ((Registration.PUB, manager.get_publications()),
                             (Registration.SUB, manager.get_subscriptions())):
            for name, type_ in topics:
                get_registration_listeners().notify_added(name, type_, kind)

    def connect(self, service: str) -> rospy.ServiceProxy:
        """Call a service once. The master, which may get no processor, has no part in later calls
        with this proxy."""
        proxy = rospy.ServiceProxy(f'{NODE}/{service}', SERVICES[service], persistent=True)
        self.call(proxy)
        return proxy

    def call(self, service: Union[str, rospy.ServiceProxy], *arguments: Any) -> Outcome:
        """Call a service. A service error is an outcome without success."""
        began = time.monotonic()
        try:
            if isinstance(service, str):
                service = rospy.ServiceProxy(f'{NODE}/{service}', SERVICES[service])
            response = service(*arguments)
        except (rospy.ServiceException, rospy.ROSException, OSError) as error:
            response = SimpleNamespace(success=False, status=None, message=repr(error))
        reading = getattr(response, 'environment', Environment())
        return Outcome(getattr(response, 'success', True), getattr(response, 'status', None),
                       getattr(response, 'message', ''), bytes(getattr(response, 'data', b'')),
                       getattr(response, 'error_code', 0),
                       _environment(reading), reading.header, began, time.monotonic())

    def start_call(self, service: Union[str, rospy.ServiceProxy],
                   *arguments: Any) -> Callable[[], Outcome]:
        """Start a call; return a function that waits for its outcome."""
        future = self._pool.submit(self.call, service, *arguments)
        return lambda: future.result(MAX_WAIT)
