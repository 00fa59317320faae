"""What the page may have the robot do, with --control: calls of services, the LED, driving.

A call is made in a thread of its own, since it may take seconds, and publishers are made in the
registrar's. Everything else here, the dead man's switch too, runs on the IO loop.
"""
import io
import threading
import time
from collections import deque
from typing import Any, Callable, Deque, Dict, Iterable, List, Optional, Tuple

import genpy
import rosgraph
import roslib.message
import rospy
from rospy.exceptions import TransportInitError
from rospy.impl.tcpros_base import TCPROSTransport
from std_msgs.msg import String
from std_srvs.srv import Empty, Trigger

from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.srv import Gimbal, Lift

from ...boards.arduino.wire import LED_LIMIT, SPEED_LIMIT
from ...boards.description import Description
from ...link.outcome import LOOK, Verdict
from ...ros.answers import read_error, read_response
from ..watch.state import BridgeState
from ..watch.topics import custom_rows, resolve
from .dead_man import SILENCE, DeadMan, Refused
from .registrar import Registrar

STEERING = (500, 2500)      # µs that a servo may be told
_AGAIN = 0.5                # s after a call in which the same is a second click, no second wish
_PATIENCE = 2.0             # s after a press in which its request is sent, or never
_MOST_CALLS = 8             # that are under way at once
_MOST_ANSWERS = 30          # that stay to be read
_TOPICS = {'speed': SpeedPWMCommand, 'led': String, 'steering': SteeringPWMCommand}


# Services that the page has controls for, by name relative to the node.
_BUILT_IN = {'~lift': Lift, '~gimbal': Gimbal, '~calibrate_imu': Empty, '~bus/echo': Trigger,
             '~bus/sync': Trigger}


def custom_services(boards: Iterable[Description], parameters: Any) -> Dict[str, Any]:
    """The services that the boards' rows make, as far as their types are installed here."""
    found = {board.custom.prefix + name: roslib.message.get_service_class(row['srv_type'])
             for board in boards for name, row in custom_rows(board, parameters).items()
             if isinstance(row.get('srv_type'), str)}
    return {name: service_class for name, service_class in found.items() if service_class}


def _fields(service_class: Any) -> List[Tuple[str, str]]:
    """Name and type of each field of the request."""
    request = service_class._request_class
    return list(zip(request.__slots__, request._slot_types))


class Commands:
    """The robot's end of the page's controls.

    Args:
        node: the bridge's full name.
        later: runs a function on the IO loop, soon; from any thread.
        call_later: runs one there after so many seconds.
    """

    def __init__(self, node: str, registrar: Registrar, later: Callable,
                 call_later: Callable) -> None:
        self._node = node
        self._registrar = registrar
        self._later = later
        self._call_later = call_later
        self._services = _BUILT_IN
        self._learned: Any = None        # the parameters that made the others
        self._answers: Deque[Dict[str, Any]] = deque(maxlen=_MOST_ANSWERS)
        # (browser, service) -> when its last call ended; None: it is under way
        self._ended: Dict[Tuple[Any, str], Optional[float]] = {}
        self._under_way = 0              # calls, also of browsers that have gone
        self._numbers = 0
        self._changed: List[Dict[str, Any]] = []
        self._wanted = False             # somebody looks
        self._publishers: Dict[str, rospy.Publisher] = {}    # the registrar sets it
        self._dead_man = DeadMan(self._stop_driving)
        self._drive_words = ''
        self._told_drive: Any = None

    # -- life ----------------------------------------------------------------------------------

    def start(self) -> None:
        """Somebody looks: the bridge gets to know our topics, so that no first command is lost."""
        self._wanted = True
        self._registrar.do(self._register)

    def stop_driving(self) -> bool:
        """Whoever drives, drives no longer; whether anybody did."""
        drove = self._dead_man.hold is not None
        self._dead_man.end()
        return drove

    def stop(self) -> None:
        """Nobody looks."""
        self._wanted = False
        self._registrar.do(self._register)

    def _register(self) -> None:
        """Have publishers while they are wanted."""
        if self._wanted and not self._publishers:
            self._publishers = {name: rospy.Publisher(
                resolve('~' + name, self._node), message_class, queue_size=1, tcp_nodelay=True)
                for name, message_class in _TOPICS.items()}
        elif not self._wanted:
            publishers, self._publishers = self._publishers, {}
            for publisher in publishers.values():
                publisher.unregister()

    def describe(self) -> Dict[str, Any]:
        """What the page needs to draw its controls."""
        return {'services': {name: _fields(each) for name, each in self._services.items()},
                'speed_limit': SPEED_LIMIT, 'steering': STEERING, 'led_limit': LED_LIMIT}

    def take(self, bridge: BridgeState) -> Dict[str, Any]:
        """What has changed since the last time, for every page.

        Args:
            bridge: its parameters make services of their own.
        """
        update: Dict[str, Any] = {}
        if bridge.parameters is not self._learned:
            self._learned = bridge.parameters
            self._services = {**_BUILT_IN, **custom_services(bridge.boards, self._learned)}
            update['controls'] = self.describe()
        if self._changed:
            update['calls'], self._changed = self._changed, []
        drive = self._driving()
        if drive != self._told_drive:
            update['drive'] = self._told_drive = drive
        return update

    def everything(self) -> Dict[str, Any]:
        """For a page that has just been opened."""
        return {'calls': list(self._answers), 'drive': self._driving(),
                'controls': self.describe()}

    def _driving(self) -> Dict[str, Any]:
        return {'held': self._dead_man.hold is not None, 'words': self._drive_words}

    # -- services ------------------------------------------------------------------------------

    def call(self, who: Any, key: str, seen: float, name: str,
             arguments: Dict[str, Any]) -> None:
        """Call a service for a browser; Refused where it is not even tried.

        Args:
            seen: the latest time of ours that the browser had seen; what a network or a suspended
                process has kept back moves nothing.
        """
        if name not in self._services:
            raise Refused(f'no service {name[:40]!r}')
        now = time.monotonic()
        _check_age(seen, now)
        last = self._ended.get((who, name), 0.0)
        if last is None or now - last < _AGAIN:
            raise Refused(f'{name}: one call at a time')
        if self._under_way >= _MOST_CALLS:
            raise Refused('too many calls are under way')
        service_class = self._services[name]
        request = _request(name, service_class, arguments)
        self._ended[who, name] = None
        self._under_way += 1
        self._numbers += 1
        entry = {'number': self._numbers, 'key': key, 'name': name,
                 'arguments': arguments, 'began': round(now, 3)}
        self._answers.append(entry)
        self._changed.append(entry)
        threading.Thread(target=self._run, args=(who, service_class, request, entry),
                         daemon=True, name=f'call {name}').start()

    def forget(self, who: Any) -> None:
        """The browser has gone; what it called goes on to its end."""
        self._dead_man.forget(who)
        self._ended = {key: at for key, at in self._ended.items() if key[0] is not who}

    def _run(self, who: Any, service_class: Any, request: Any, entry: Dict[str, Any]) -> None:
        outcome, words = _call(resolve(entry['name'], self._node), service_class, request,
                               entry['began'] + _PATIENCE)
        self._later(self._answered, who, entry, outcome, words)

    def _answered(self, who: Any, entry: Dict[str, Any], outcome: Verdict, words: str) -> None:
        now = time.monotonic()
        entry.update(outcome=outcome.value, words=words, took=round(now - entry['began'], 3))
        self._under_way -= 1
        if (who, entry['name']) in self._ended:
            self._ended[who, entry['name']] = now
        self._changed.append(entry)

    # -- the car -------------------------------------------------------------------------------

    def led(self, seen: float, text: str) -> None:
        """Show this on the car's LEDs; `seen` as for a call."""
        _check_age(seen, time.monotonic())
        if len(text) > LED_LIMIT or not text.isascii() or '\0' in text:
            raise Refused(f'the LED takes at most {LED_LIMIT} characters of ASCII')
        try:
            self._publisher('led').publish(text)
        except rospy.ROSException as error:
            raise Refused(f'nothing was sent: {error}') from None     # shutting down

    def drive(self, who: Any, hold: int, seen: float, speed: int, steering: int) -> None:
        """Drive, as long as this browser says so again and again."""
        now = time.monotonic()
        publisher = self._publisher('speed')
        try:
            self._dead_man.command(who, hold, seen, now)
        except Refused as refused:
            self._drive_words = str(refused)
            raise
        self._drive_words = ''
        stamp = rospy.Time.now()
        self._publish_speed(publisher, max(-SPEED_LIMIT, min(SPEED_LIMIT, speed)), stamp)
        command = SteeringPWMCommand(value=max(STEERING[0], min(STEERING[1], steering)))
        command.header.stamp = stamp
        self._publisher('steering').publish(command)
        self._call_later(SILENCE, self._check)

    def release(self, who: Any, hold: int) -> None:
        """The pad is held no longer."""
        self._dead_man.release(who, hold)

    def _check(self) -> None:
        held = self._dead_man.hold
        self._dead_man.check(time.monotonic())
        if held and not self._dead_man.hold:
            self._drive_words = 'the browser fell silent: stopped'

    def _stop_driving(self) -> None:
        publisher = self._publishers.get('speed')
        if publisher:
            self._publish_speed(publisher, 0, rospy.Time.now())

    @staticmethod
    def _publish_speed(publisher: rospy.Publisher, speed: int, stamp: rospy.Time) -> None:
        command = SpeedPWMCommand(value=speed)
        command.header.stamp = stamp
        try:
            publisher.publish(command)
        except rospy.ROSException:
            pass    # shutting down: the bridge's own timeout stops the car

    def _publisher(self, name: str) -> rospy.Publisher:
        publisher = self._publishers.get(name) if self._wanted else None
        if publisher is None or not publisher.get_num_connections():
            raise Refused(f'the bridge does not listen to ~{name}: its arduino link is off, '
                          'or it does not run')
        return publisher


def _check_age(seen: float, now: float) -> None:
    """Refused if the browser sent this before it saw what is due since."""
    if not 0 <= now - seen <= _PATIENCE:
        raise Refused(f'it came {now - seen:.1f} s late, nothing was sent: press again')


def _request(name: str, service_class: Any, arguments: Dict[str, Any]) -> Any:
    """The request with these fields; Refused where they are not the service's."""
    names = [field for field, _type in _fields(service_class)]
    if sorted(arguments) != sorted(names):
        raise Refused(f'{name} takes {", ".join(names) or "nothing"}')
    request = service_class._request_class(**arguments)
    try:
        request._check_types()
        request.serialize(io.BytesIO())     # a float beyond its type, say
    except (genpy.SerializationError, ArithmeticError) as error:
        raise Refused(f'{name}: {error}') from None
    return request


def _connected(name: str, service_class: Any, deadline: float) -> rospy.ServiceProxy:
    """A proxy whose request leaves at once.

    rospy's own asks the master and connects as it is called: a request would be sent as soon as
    they answer, however long they have hung, and the robot move when nobody expects it any more.

    Raises:
        rosgraph.MasterError: there is no such service.
        OSError: the master does not answer.
        rospy.ROSException: the bridge does not answer, or the deadline has passed.
    """
    uri = rosgraph.Master(rospy.get_name()).lookupService(name)
    proxy = rospy.ServiceProxy(name, service_class)
    proxy.transport = TCPROSTransport(proxy.protocol, proxy.resolved_name)
    try:
        proxy.transport.connect(*rospy.core.parse_rosrpc_uri(uri), uri, timeout=_PATIENCE)
    except TransportInitError:
        proxy.close()
        raise rospy.ROSException('the bridge does not answer') from None
    if time.monotonic() > deadline:
        proxy.close()
        raise rospy.ROSException(f'master and bridge took more than {_PATIENCE:g} s to answer; '
                                 'call again')
    return proxy


def _call(name: str, service_class: Any, request: Any, deadline: float) -> Tuple[Verdict, str]:
    """Call it: how it went, and in words. Nothing is sent after the deadline."""
    try:
        proxy = _connected(name, service_class, deadline)
    except Exception as error:  # pylint: disable=broad-except
        why = 'no bridge offers this now' if isinstance(error, rosgraph.MasterError) \
            else 'the ROS master does not answer' if isinstance(error, OSError) else error
        return Verdict.REFUSED, f'nothing was sent: {why}'
    try:
        return read_response(proxy(request))
    except rospy.ServiceException as error:
        return read_error(error)
    except Exception as error:  # pylint: disable=broad-except
        return Verdict.NOT_KNOWN, f'the call failed: {error}; {LOOK}'
