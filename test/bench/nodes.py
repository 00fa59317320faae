"""The ROS nodes that the bench sets beside the bridge, each a child process.

    reference   polls its ports 200 times a second, as nodes for this job commonly do
    floor       publishes ready-made messages: what rospy itself costs
    subscriber  stamps what arrives
    caller      calls the bus services, several at once
"""
import sys
import threading
import time
from math import radians
from typing import Any, Callable, Dict, List

import rospy
import serial
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from roslib.message import get_message_class
from sensor_msgs.msg import Imu, Range, RelativeHumidity, Temperature
from std_srvs.srv import Trigger

from serial_communication.msg import Environment, SteeringFeedback, Ticks, Voltage
from serial_communication.srv import BusRequest, GetEnvironment

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.ros.geometry import quaternion
from processes import NODE
from serial_communication.tools.watch.topics import resolve
from .boards import LINKS, RAW_COMMAND, imu_count, measured_topics
from .child import serve, sleep_until
from .decoders import ByteArduino, ByteBus, ByteMcu

POLLS = 200                # a second
HEARTBEAT_EVERY = 2        # polls
ENVIRONMENT_EVERY = 10     # polls; the bridge is set to the same period

# Every topic that the bridge publishes at the boards' rates, as the bridge names it: with its
# type, and where the message holds the running number that the board put in.
TOPICS = {topic.name: get_message_class(topic.type) for topic in measured_topics(*LINKS)}
COUNTS: Dict[str, Callable[[Any], int]] = {
    '~imu': lambda m: imu_count(m.linear_acceleration.z), '~ticks': lambda m: m.value,
    '~steering_angle': lambda m: m.value, '~voltage': lambda m: round(m.value * 128),
    '~environment': lambda m: m.smoke, 'mcu/status': lambda m: m.vl53_1}


class Reference:
    """One loop for all three ports: read what is there, a byte at a time, publish, sleep."""

    def __init__(self, ports: Dict[str, str]) -> None:
        self._ports = {link: serial.Serial(port, 115200, timeout=0)
                       for link, port in ports.items()}
        self._decoders = {'arduino': ByteArduino(), 'mcu': ByteMcu(), 'bus': ByteBus()}
        self._topics = {name: rospy.Publisher(name, message_class, queue_size=10)
                        for name, message_class in TOPICS.items()}
        self._handlers: Dict[type, Callable[[Any], None]] = {
            arduino.Imu: self._imu, mcu.SensorStatus: self._status, bus.Reply: self._reply,
            arduino.Ticks: lambda m: self._value('~ticks', Ticks, m),
            arduino.SteeringAngle: lambda m: self._value('~steering_angle', SteeringFeedback, m),
            arduino.Voltage: lambda m: self._value('~voltage', Voltage, m),
        }
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        rate = rospy.Rate(POLLS)
        heartbeat = arduino.encode(arduino.Heartbeat())
        question = bus.encode_request(bus.ENVIRONMENT_REQUEST)
        polls = 0
        while not rospy.is_shutdown():
            for link, port in self._ports.items():
                waiting = port.in_waiting
                if waiting:
                    for message in self._decoders[link].feed(port.read(waiting)):
                        self._handlers[type(message)](message)
            if polls % HEARTBEAT_EVERY == 0:
                self._ports['arduino'].write(heartbeat)
            if polls % ENVIRONMENT_EVERY == 0:
                self._ports['bus'].write(question)
            polls += 1
            rate.sleep()

    def _publish(self, topic: str, message: Any) -> None:
        message.header.stamp = rospy.Time.now()
        self._topics[topic].publish(message)

    def _value(self, topic: str, message_class: type, message: Any) -> None:
        self._publish(topic, message_class(value=message.value))

    def _imu(self, message: arduino.Imu) -> None:
        out = Imu()
        out.header.frame_id = 'imu'
        (out.orientation.x, out.orientation.y, out.orientation.z,
         out.orientation.w) = message.orientation()
        (out.angular_velocity.x, out.angular_velocity.y,
         out.angular_velocity.z) = message.angular_velocity()
        (out.linear_acceleration.x, out.linear_acceleration.y,
         out.linear_acceleration.z) = message.linear_acceleration()
        self._publish('~imu', out)
        self._publish('~imu/temperature', Temperature(temperature=message.temperature()))

    def _status(self, message: mcu.SensorStatus) -> None:
        self._topics['mcu/status'].publish(rospy.Time.now(), 0, True, message.valid, 0, 0.0,
                                           *message)
        for topic, value in (('mcu/range_1', message.range_1), ('mcu/range_2', message.range_2)):
            self._publish(topic, Range(min_range=0.03, max_range=2.0, range=value / 1000))
        out = Imu()
        (out.orientation.x, out.orientation.y, out.orientation.z,
         out.orientation.w) = quaternion(radians(message.roll), radians(message.pitch),
                                         -radians(message.yaw))
        self._publish('mcu/imu', out)

    def _reply(self, reply: bus.Reply) -> None:
        if len(reply.data) != bus.Environment.LAYOUT.size:
            return
        reading = bus.Environment.unpack(reply.data)
        self._publish('~environment', Environment(None, *reading))
        self._publish('~environment/temperature',
                      Temperature(temperature=reading.temperature))
        self._publish('~environment/humidity',
                      RelativeHumidity(relative_humidity=reading.humidity / 100))


class Floor:
    """The bridge's messages at the boards' rates from plain sleep loops, and nothing else."""

    def __init__(self) -> None:
        def topic(name: str) -> rospy.Publisher:
            # As the bridge has its publishers, so that the comparison is of the rest.
            return rospy.Publisher(name, TOPICS[name], queue_size=100, tcp_nodelay=True)

        diagnostics = rospy.Publisher('diagnostics', DiagnosticArray, queue_size=100,
                                      tcp_nodelay=True)
        # As many and as long as the bridge's three.
        values = [KeyValue(f'bytes received {n}', '1234567') for n in range(15)]
        array = DiagnosticArray(status=[DiagnosticStatus(
            0, 'serial_communication: bus link', 'open', '/dev/ttyUSB0', values)])
        self._loops = {rate: [(topic(each.name), _ready_made(each.name))
                              for each in measured_topics(link)]
                       for link, rate in (('arduino', 100.0), ('mcu', 20.0), ('bus', 1.0))}
        self._loops[1.0] += [(diagnostics, array)] * 3

    def publish(self, seconds: float) -> int:
        """For so long; returns how many messages."""
        counts: List[int] = []
        threads = [threading.Thread(target=self._loop, args=(rate, topics, seconds, counts))
                   for rate, topics in self._loops.items()]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return sum(counts)

    @staticmethod
    def _loop(rate: float, topics: list, seconds: float, counts: List[int]) -> None:
        start = time.monotonic()
        turns = 0
        while turns / rate < seconds:
            for topic, message in topics:
                topic.publish(message)
            turns += 1
            sleep_until(start + min(turns / rate, seconds))
        counts.append(turns * len(topics))


def _ready_made(name: str) -> Any:
    message = TOPICS[name]()
    if hasattr(message, 'header'):
        message.header.frame_id = 'imu'
        message.header.stamp = rospy.Time.now()
    return message


class Subscriber:
    """Receives every topic of some namespaces; stamps those that hold a running number."""

    def __init__(self, namespaces: List[str]) -> None:
        self._received: Dict[str, Dict[str, list]] = {}
        self._counts: Dict[str, int] = {}
        self._subscribers = []
        for namespace in namespaces:
            for name, message_class in TOPICS.items():
                self._subscribers.append(self._subscribe(namespace, name, message_class))
            # Who does not publish it, the reference, is not waited for.
            self._subscribe(namespace, 'diagnostics', DiagnosticArray)

    def _subscribe(self, namespace: str, name: str, message_class: type) -> rospy.Subscriber:
        counts, topic = self._counts, resolve(name, f'{namespace}/{NODE}')
        counts[topic] = 0
        count = COUNTS.get(name)
        if count is None:
            def callback(_message):
                counts[topic] += 1
        else:
            stamps = self._received.setdefault(namespace, {}).setdefault(name, [])
            monotonic = time.monotonic

            def callback(message):
                stamps.append((count(message), monotonic()))
                counts[topic] += 1
        return rospy.Subscriber(topic, message_class, callback, tcp_nodelay=True)

    def missing(self) -> List[str]:
        """The topics that nobody publishes to it yet."""
        return [subscriber.resolved_name for subscriber in self._subscribers
                if not subscriber.get_num_connections()]

    def silent(self, namespace: str) -> List[str]:
        """The topics of which nothing has come since `begin`."""
        return [subscriber.resolved_name for subscriber in self._subscribers
                if subscriber.resolved_name.startswith(namespace + '/')
                and not self._counts[subscriber.resolved_name]]

    def begin(self) -> bool:
        """Forget what was before."""
        self._counts.update(dict.fromkeys(self._counts, 0))
        for kinds in self._received.values():
            for stamps in kinds.values():
                del stamps[:]
        return True

    def counts(self) -> Dict[str, int]:
        """Messages since `begin`, by topic."""
        return self._counts

    def collect(self, namespace: str) -> Dict[str, list]:
        """[number, time of the callback] by topic, since `begin`."""
        return self._received[namespace]


class Caller:
    """Calls the bus services of one bridge from several threads at once."""

    def __init__(self, namespace: str) -> None:
        self._prefix = f'{namespace}/{NODE}/'

    def _ask(self, kind: str) -> Callable[[], Any]:
        """A connection of its own; a call returns the number in the answer, -1 without one."""
        if kind == 'environment':
            environment = rospy.ServiceProxy(self._prefix + 'get_environment', GetEnvironment, True)

            def ask():
                answer = environment()
                return answer.environment.smoke if answer.success else None
        elif kind == 'echo':
            echo = rospy.ServiceProxy(self._prefix + 'bus/echo', Trigger, True)

            def ask():
                return -1 if echo().success else None
        else:
            raw = rospy.ServiceProxy(self._prefix + 'bus/request', BusRequest, True)

            def ask():
                answer = raw(bus.FUNCTION, RAW_COMMAND, b'')
                return int.from_bytes(answer.data, 'little') if answer.success else None
        return ask

    def ready(self) -> bool:
        """Wait until the bus answers."""
        rospy.wait_for_service(self._prefix + 'bus/echo', 20)
        return self._ask('echo')() is not None

    def call(self, kind: str, callers: int, seconds: float) -> List[tuple]:
        """Call as fast as it goes; (time of the call, of the answer, number or None)."""
        calls: List[tuple] = []
        kinds = ['environment', 'echo', 'raw'] if kind == 'mixed' else [kind]
        asks = [self._ask(kinds[n % len(kinds)]) for n in range(callers)]
        until = time.monotonic() + seconds

        def loop(ask):
            while time.monotonic() < until:
                start = time.monotonic()
                number = ask()
                calls.append((start, time.monotonic(), number))

        threads = [threading.Thread(target=loop, args=(ask,)) for ask in asks]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return calls


def main() -> None:
    """nodes ROLE [ARGUMENT…]."""
    role, arguments = sys.argv[1], sys.argv[2:]
    sys.setswitchinterval(0.0005)
    name = NODE if role in ('reference', 'floor') else role
    rospy.init_node(name, argv=[name], disable_signals=True)
    if role == 'reference':
        Reference(dict(argument.split('=', 1) for argument in arguments))
        serve()
    elif role == 'floor':
        floor = Floor()
        serve(publish=floor.publish)
    elif role == 'subscriber':
        subscriber = Subscriber(arguments)
        serve(missing=subscriber.missing, silent=subscriber.silent, begin=subscriber.begin,
              collect=subscriber.collect, counts=subscriber.counts)
    else:
        caller = Caller(arguments[0])
        serve(ready=caller.ready, call=caller.call)


if __name__ == '__main__':
    main()
