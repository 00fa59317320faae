"""The other ROS nodes of the bench, each a child process.

    polling     a reference: polls its port 200 times a second, as many drivers do
    publishing  a reference: only publishes prepared messages, the cost of rospy itself
    subscriber  stamps IMU and steering as they arrive
    counter     counts the messages on every topic of a node
    caller      calls the bus services, several at once; sets a setting
"""
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Callable, Dict, List

import rospy
import serial
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from dynamic_reconfigure.msg import Config, DoubleParameter
from dynamic_reconfigure.srv import Reconfigure
from geometry_msgs.msg import Quaternion, Vector3
from roslib.message import get_message_class
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from serial_communication.boards import BOARDS, description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.msg import SteeringFeedback
from serial_communication.srv import GetEnvironment
from .boards import imu_count
from .child import serve, sleep_until
from .processes import NODE
from .tcpros import Counter

POLLS = 200                # a second
HEARTBEAT_EVERY = 2        # polls


def topics_of_boards() -> Dict[str, str]:
    """Return the type of each topic of every board, by the name relative to the node."""
    return {topic.name: topic.type for name in BOARDS
            for topic in description(name).topics if not topic.optional}


class Polling:
    """Reads the bytes available, publishes, and sleeps."""

    def __init__(self, port: str) -> None:
        self._port = serial.Serial(port, 115200, timeout=0)
        self._imu = rospy.Publisher('~imu', Imu, queue_size=10)
        self._steering = rospy.Publisher('~steering_angle', SteeringFeedback, queue_size=10)
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        decoder = arduino.Decoder()
        rate, polls = rospy.Rate(POLLS), 0
        while True:
            for frame in decoder.feed(self._port.read(self._port.in_waiting)):
                self._publish(frame.message)
            if polls % HEARTBEAT_EVERY == 0:
                self._port.write(arduino.encode(arduino.Heartbeat()))
            polls += 1
            rate.sleep()

    def _publish(self, message: Any) -> None:
        if isinstance(message, arduino.SteeringAngle):
            out = SteeringFeedback(value=message.value)
            out.header.stamp = rospy.Time.now()
            self._steering.publish(out)
        elif isinstance(message, arduino.Imu):
            out = Imu()
            out.header.stamp = rospy.Time.now()
            out.orientation = Quaternion(*message.orientation())
            out.angular_velocity = Vector3(*message.angular_velocity())
            out.linear_acceleration = Vector3(*message.linear_acceleration())
            self._imu.publish(out)


class Publishing:
    """Publishes the bridge's messages at the bridge's rates from sleep loops, and does no more."""

    def __init__(self) -> None:
        # With the publishers' settings of the bridge, so that only the rest is compared.
        self._topics = {name: (rospy.Publisher(name, kind, queue_size=100, tcp_nodelay=True),
                               _prepared(kind))
                        for name, kind in [('diagnostics', DiagnosticArray)] + [
                            (name, get_message_class(type_))
                            for name, type_ in topics_of_boards().items()]}

    def publish(self, rates: Dict[str, int], seconds: float) -> bool:
        """Publish for `seconds`; `rates` in Hz by the topics' names relative to the node."""
        loops: Dict[int, list] = {}
        for name, rate in rates.items():
            loops.setdefault(rate, []).append(self._topics[name])

        def loop(rate: int, topics: list) -> None:
            start = time.monotonic()
            for turn in range(1, round(rate * seconds) + 1):
                for topic, message in topics:
                    topic.publish(message)
                sleep_until(start + turn / rate)

        with ThreadPoolExecutor(len(loops)) as threads:
            list(threads.map(loop, loops, loops.values()))
        return True


def _prepared(kind: type) -> Any:
    message = kind()
    if kind is DiagnosticArray:     # of the size of the bridge's
        values = [KeyValue(f'bytes received {n}', '1234567') for n in range(15)]
        message.status = [DiagnosticStatus(0, 'serial_communication: bus link', 'open',
                                           '/dev/ttyUSB0', values)]
    if hasattr(message, 'header'):
        message.header.frame_id = 'imu'
        message.header.stamp = rospy.Time.now()
    return message


class Subscriber:
    """Stamps the running numbers on the IMU and steering topics of several nodes."""

    def __init__(self, nodes: List[str]) -> None:
        self._received: Dict[str, List[list]] = {}
        self._subscribers = []
        for node in nodes:
            self._received[node] = []
            self._subscribe(node, 0, 'imu', Imu, lambda m: imu_count(m.linear_acceleration.z))
            self._subscribe(node, 1, 'steering_angle', SteeringFeedback, lambda m: m.value)

    def _subscribe(self, node: str, packet: int, name: str, kind: type,
                   number: Callable[[Any], int]) -> None:
        received = self._received[node]
        self._subscribers.append(rospy.Subscriber(
            f'{node}/{name}', kind,
            lambda message: received.append((packet, number(message), time.monotonic(),
                                             message.header.stamp.to_sec())),
            tcp_nodelay=True))

    def missing(self) -> List[str]:
        """Return the topics without a connected publisher."""
        return [subscriber.resolved_name for subscriber in self._subscribers
                if not subscriber.get_num_connections()]

    def take(self, node: str) -> List[list]:
        """Return [index of the packet in its turn, running number, time of the callback, stamp] of
        each message since the last call."""
        count = len(self._received[node])
        taken = self._received[node][:count]
        del self._received[node][:count]
        return taken


class Caller:
    """Calls the bus services of a bridge from several threads at once."""

    def __init__(self) -> None:
        self._proxies: Dict[str, list] = {}

    def ready(self, node: str, callers: int) -> bool:
        """Connect each caller; return whether the bus answers."""
        for name, kind in (('get_environment', GetEnvironment), ('bus/echo', Trigger)):
            rospy.wait_for_service(f'{node}/{name}', 20)
            self._proxies[f'{node}/{name}'] = [
                rospy.ServiceProxy(f'{node}/{name}', kind, True) for _ in range(callers)]
        return self._proxies[f'{node}/bus/echo'][0]().success

    def call(self, service: str, seconds: float) -> List[tuple]:
        """Call as fast as possible; return (time of the call, of the answer, success) of each."""
        calls: List[tuple] = []
        until = time.monotonic() + seconds

        def loop(proxy):
            while time.monotonic() < until:
                start = time.monotonic()
                success = proxy().success
                calls.append((start, time.monotonic(), success))

        with ThreadPoolExecutor(len(self._proxies[service])) as threads:
            list(threads.map(loop, self._proxies[service]))
        return calls

    def set(self, service: str, seconds: float, pause: float) -> List[float]:
        """Set `gain` to another value again and again; return how long each answer took, in s.

        Args:
            pause: s between two calls.
        """
        rospy.wait_for_service(service, 20)
        proxy, times = rospy.ServiceProxy(service, Reconfigure, True), []
        until, number = time.monotonic() + seconds, 0
        while time.monotonic() < until:
            number += 1
            began, value = time.monotonic(), float(number % 100)
            answer = proxy(Config(doubles=[DoubleParameter('gain', value)]))
            times.append(time.monotonic() - began)
            assert answer.config.doubles[0].value == value
            time.sleep(pause)
        return times


def main() -> None:
    """nodes ROLE [ARGUMENT…]."""
    role, arguments = sys.argv[1], sys.argv[2:]
    sys.setswitchinterval(0.0005)
    if role == 'counter':     # without rospy: see tcpros
        counter = Counter()
        serve(connect=counter.connect, waiting=counter.waiting, take=counter.take)
    name = NODE if role in ('polling', 'publishing') else role
    rospy.init_node(name, argv=[name], disable_signals=True)
    if role == 'polling':
        Polling(*arguments)
        serve()
    elif role == 'publishing':
        serve(publish=Publishing().publish)
    elif role == 'subscriber':
        subscriber = Subscriber(arguments)
        serve(missing=subscriber.missing, take=subscriber.take)
    else:
        caller = Caller()
        serve(ready=caller.ready, call=caller.call, set=caller.set)


if __name__ == '__main__':
    main()
