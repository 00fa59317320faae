"""The commands of the page, with --control: service calls, STOP, messages to the boards, driving.

Each call runs in its own thread, since it may take seconds; the registrar's thread creates the
publishers. Everything else runs on the IO loop, including the dead man's switch.
"""
import io
import math
import threading
import time
from collections import deque
from itertools import islice
from typing import Any, Callable, Deque, Dict, List, Optional, Tuple

import genpy
import rospy
from std_msgs.msg import String
from std_srvs.srv import SetBool, SetBoolRequest

from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand

from ...boards.arduino.wire import LED_LIMIT, SPEED_LIMIT
from ...ros.fields import outcome_fields
from ...ros.background import LatestWorker
from ...ros.settings import request_of, value_in
from ..watch.calls import MOST_WAIT, Answer, Verdict, call
from ..watch.state import BridgeState
from ..watch.topics import absolute, leaves, one_line
from .dead_man import SILENCE, CommandRefused, DeadManSwitch
from .forms import (Message, Service, board_services, custom_messages, custom_services,
                    settings)

STEERING = (500, 2500)      # µs, the range of a servo
_DOUBLE_CLICK = 0.5         # s after a call in which another one of its service is refused
_MAX_AGE = MOST_WAIT        # s from a click until its request is sent; later it is refused
_MAX_CALLS = 8              # under way at once; likewise STOPs
_MAX_ANSWERS = 30           # kept for the pages
_MAX_REPLY = 40             # fields of a response that are shown
_MAX_REPLY_TEXT = 200       # characters of each
_STOP = Service(SetBool, '', [])
_STOP_ANSWER = 0.5          # s for the bridge to answer a STOP; then SPEED 0 is sent instead
_SENT = 'sent'              # the outcome of what no board answers
_TO_THE_BRIDGE = 'to the bridge; this command has no answer'
_TOPICS = {'~speed': SpeedPWMCommand, '~led': String, '~steering': SteeringPWMCommand}


class Commands:
    """Executes the commands of all pages.

    Args:
        node: the bridge's full name.
        add_callback: runs a function soon on the IO loop; may be called from any thread.
        call_later: runs a function on the IO loop after a delay in seconds.
    """

    def __init__(self, node: str, registrar: LatestWorker, add_callback: Callable,
                 call_later: Callable) -> None:
        self._node = node
        self._registrar = registrar
        self._add_callback = add_callback
        self._call_later = call_later
        self._services: Dict[str, Service] = {}      # by name relative to the node
        self._messages: Dict[str, Message] = {}
        self._parameters: Any = None     # that both were made from
        self._answers: Deque[Dict[str, Any]] = deque(maxlen=_MAX_ANSWERS)
        # (page, service) -> when its last call ended; None: it is under way
        self._ended: Dict[Tuple[Any, str], Optional[float]] = {}
        self._under_way = {False: 0, True: 0}   # STOPs (True) and calls, also of closed pages
        self._last_number = 0            # of a call
        self._changed: List[Dict[str, Any]] = []
        self._wanted = False             # whether a page is open
        self._publishers: Dict[str, rospy.Publisher] = {}    # set in the registrar's thread
        self._switch = DeadManSwitch(self._publish_zero)
        self._sent_drive: Optional[bool] = None

    # -- start and stop ------------------------------------------------------------------------

    def start(self) -> None:
        """A page is open: register the publishers now, so that no first command is lost."""
        self._wanted = True
        self._registrar.submit(self._register)

    def stop_driving(self) -> bool:
        """Stop the car if a page drives; return whether one did."""
        drove = self._switch.hold is not None
        self._switch.end()
        return drove

    def stop(self) -> None:
        """No page is open: unregister the publishers."""
        self._wanted = False
        self._registrar.submit(self._register)

    def _register(self) -> None:
        """Create and unregister publishers. Runs in the registrar's thread."""
        classes = {**_TOPICS, **{name: each.row.ros_class
                                 for name, each in self._messages.items()}} if self._wanted else {}
        for name, publisher in list(self._publishers.items()):
            if publisher.data_class is not classes.get(name):
                del self._publishers[name]
                publisher.unregister()
        for name in set(classes) - set(self._publishers):
            self._publishers[name] = rospy.Publisher(
                absolute(name, self._node), classes[name], queue_size=1, tcp_nodelay=True)

    def describe(self) -> Dict[str, Any]:
        """What the page needs to build its controls."""
        return {'services': {name: {'link': each.link, 'fields': each.fields,
                                    'title': each.title, 'confirm': each.confirm,
                                    'setting': each.setting.name if each.setting else '',
                                    'about': each.setting.description if each.setting else ''}
                             for name, each in self._services.items()},
                'messages': {name: {'link': each.link, 'fields': each.fields}
                             for name, each in self._messages.items()},
                'speed_limit': SPEED_LIMIT, 'steering': STEERING, 'led_limit': LED_LIMIT}

    def changes(self, bridge: BridgeState) -> Dict[str, Any]:
        """What has changed since the last call, for every page.

        Args:
            bridge: whose services and custom functions are offered.
        """
        update: Dict[str, Any] = {}
        if bridge.parameters is not self._parameters:
            self._parameters = bridge.parameters
            self._services = {**board_services(bridge.boards),
                              **custom_services(bridge.boards, self._parameters),
                              **settings(bridge.boards, self._parameters), '~stop': _STOP}
            self._messages = custom_messages(bridge.boards, self._parameters)
            self._registrar.submit(self._register)
            update['controls'] = self.describe()
        if self._changed:
            update['calls'], self._changed = self._changed, []
        drives = self._switch.hold is not None
        if drives != self._sent_drive:
            update['drives'] = self._sent_drive = drives
        return update

    def snapshot(self) -> Dict[str, Any]:
        """The whole state, for a page that has just been opened."""
        return {'calls': list(self._answers), 'drives': self._switch.hold is not None,
                'controls': self.describe()}

    # -- services ------------------------------------------------------------------------------

    def call(self, page: Any, key: str, seen: float, name: str,
             arguments: Dict[str, Any]) -> None:
        """Call a service for a page.

        Args:
            key: by which the page recognises its call.
            seen: time of the latest update that the page had seen, s. A request that a network or
                a suspended process has delayed must not move the robot.

        Raises:
            CommandRefused: the service is not called.
        """
        if name not in self._services:
            raise CommandRefused(f'{name[:40]!r} is not a service of the page')
        now = time.monotonic()
        _check_age(seen, now)
        self._refuse_second(page, name, now)
        service = self._services[name]
        request = _request(name, service, arguments)
        self._ended[page, name] = None
        self._begin(page, service, request, self._add_answer(key, name, arguments, now),
                    seen + _MAX_AGE)

    def press_stop(self, key: str) -> None:
        """End any page's driving and call ~stop, at any time and however old the command is.

        SPEED 0 is sent if the bridge does not confirm the STOP in time.
        """
        self._switch.end()
        entry = self._add_answer(key, '~stop', {'data': True}, time.monotonic())
        self._call_later(_STOP_ANSWER, self._fall_back, entry)
        self._begin(None, _STOP, SetBoolRequest(True), entry, math.inf)

    def _fall_back(self, stop: Dict[str, Any]) -> None:
        """Send SPEED 0 unless the bridge has confirmed this STOP."""
        if stop.get('outcome') != Verdict.DONE.value:
            self._publish_zero()

    def forget(self, page: Any) -> None:
        """The page is closed: stop its driving. Its calls continue."""
        self._switch.forget(page)
        self._ended = {key: at for key, at in self._ended.items() if key[0] is not page}

    def _begin(self, page: Any, service: Service, request: Any, entry: Dict[str, Any],
               deadline: float) -> None:
        """Call the service in a thread of its own; `page` is None for a STOP."""
        self._under_way[page is None] += 1
        try:
            if self._under_way[page is None] > _MAX_CALLS:
                raise RuntimeError(f'{_MAX_CALLS} calls are under way, which is the limit')
            threading.Thread(target=self._run, args=(page, service, request, entry, deadline),
                             daemon=True, name=f'call {entry["name"]}').start()
        except RuntimeError as error:       # or no memory for a thread
            self._answered(page, service, entry,
                           Answer(Verdict.REFUSED, f'nothing was sent: {error}'))

    def _run(self, page: Any, service: Service, request: Any, entry: Dict[str, Any],
             deadline: float) -> None:
        answer = call(absolute(service.service_name(entry['name']), self._node),
                      service.service_class, request, deadline)
        self._add_callback(self._answered, page, service, entry, answer)

    def _answered(self, page: Any, service: Service, entry: Dict[str, Any],
                  answer: Answer) -> None:
        now = time.monotonic()
        reply = _reply(service, answer.response) if answer.outcome is Verdict.DONE else []
        entry.update(outcome=answer.outcome.value, words=answer.words, reply=reply,
                     took=round(now - entry['began'], 3))
        self._under_way[page is None] -= 1
        if page is None:
            self._fall_back(entry)
        if (page, entry['name']) in self._ended:
            self._ended[page, entry['name']] = now
        self._changed.append(entry)

    def _refuse_second(self, page: Any, name: str, now: float) -> None:
        """Raise CommandRefused if the page has just sent this command: it may be a double click."""
        last = self._ended.get((page, name), 0.0)
        if last is None or now - last < _DOUBLE_CLICK:
            raise CommandRefused(f'{name}: one call at a time; wait for the answer')

    def _add_answer(self, key: str, name: str, arguments: Dict[str, Any], now: float,
                    **more: Any) -> Dict[str, Any]:
        self._last_number += 1
        entry = {'number': self._last_number, 'key': key, 'name': name,
                 'arguments': arguments, 'began': round(now, 3), **more}
        self._answers.append(entry)
        self._changed.append(entry)
        return entry

    # -- messages ------------------------------------------------------------------------------

    def led(self, key: str, seen: float, text: str) -> None:
        """Send this text to the car's LEDs; arguments and errors as for a call."""
        now = time.monotonic()
        _check_age(seen, now)
        if len(text) > LED_LIMIT or not text.isascii() or '\0' in text:
            raise CommandRefused(
                f'the LED takes at most {LED_LIMIT} ASCII characters, not {text[:40]!r}')
        self._send(key, '~led', {'text': text}, String(text), now)

    def send(self, page: Any, key: str, seen: float, name: str, values: Dict[str, Any]) -> None:
        """Send a custom command with these values, by field; arguments and errors as for a call."""
        if name not in self._messages:
            raise CommandRefused(f'{name[:40]!r} is not a command of the page')
        now = time.monotonic()
        _check_age(seen, now)
        self._refuse_second(page, name, now)
        message = self._messages[name].make(values)
        if message._has_header:
            message.header.stamp = rospy.Time.now()
        self._ended[page, name] = now
        self._send(key, name, values, message, now)

    def _send(self, key: str, name: str, arguments: Dict[str, Any], message: Any,
              now: float) -> None:
        try:
            self._publisher(name).publish(message)
        except rospy.ROSException as error:
            raise CommandRefused(f'nothing was sent: {error}') from None     # rospy shuts down
        self._add_answer(key, name, arguments, now, outcome=_SENT, took=0.0,
                         words=_TO_THE_BRIDGE)

    # -- the car -------------------------------------------------------------------------------

    def drive(self, page: Any, hold: int, seen: float, speed: int, steering: int) -> None:
        """Drive until the page has not repeated this for SILENCE.

        Args:
            hold: number of the press that this command belongs to.
            seen: time of the latest update that the page had seen, s.
            speed: -1000 … 1000; limited to that.
            steering: µs, 500 … 2500; limited to that.

        Raises:
            CommandRefused: nothing is sent.
        """
        now = time.monotonic()
        speeds, steerings = self._publisher('~speed'), self._publisher('~steering')
        self._switch.command(page, hold, seen, now)
        # Before anything that may fail.
        self._call_later(SILENCE, lambda: self._switch.check(time.monotonic()))
        stamp = rospy.Time.now()
        self._publish_speed(speeds, max(-SPEED_LIMIT, min(SPEED_LIMIT, speed)), stamp)
        command = SteeringPWMCommand(value=max(STEERING[0], min(STEERING[1], steering)))
        command.header.stamp = stamp
        steerings.publish(command)

    def release(self, page: Any, hold: int) -> None:
        """The page's pad is no longer held: stop the car."""
        self._switch.release(page, hold)

    def _publish_zero(self) -> None:
        publisher = self._publishers.get('~speed')
        if publisher:
            self._publish_speed(publisher, 0, rospy.Time.now())

    @staticmethod
    def _publish_speed(publisher: rospy.Publisher, speed: int, stamp: rospy.Time) -> None:
        command = SpeedPWMCommand(value=speed)
        command.header.stamp = stamp
        try:
            publisher.publish(command)
        except rospy.ROSException:
            pass    # rospy shuts down: the bridge's own timeout stops the car

    def _publisher(self, name: str) -> rospy.Publisher:
        publisher = self._publishers.get(name) if self._wanted else None
        if publisher is None or not publisher.impl.has_connection(self._node):
            raise CommandRefused(f'the bridge does not subscribe to {name}: it does not run, '
                                 'or that link is off')
        return publisher


def _check_age(seen: float, now: float) -> None:
    """Raise CommandRefused if the latest update that the page had seen is too old."""
    if not 0 <= now - seen <= _MAX_AGE:
        raise CommandRefused(f'nothing was sent: the command is {now - seen:.1f} s old, '
                             f'at most {_MAX_AGE:g} s; press again')


def _request(name: str, service: Service, arguments: Dict[str, Any]) -> Any:
    """The request with these fields; CommandRefused if they do not fit the service."""
    if service.setting:
        try:
            return request_of(service.setting, arguments.get('value'))
        except ValueError as error:
            raise CommandRefused(f'{name} {error}') from None
    service_class = service.service_class
    names = service_class._request_class.__slots__
    if sorted(arguments) != sorted(names):
        raise CommandRefused(f'{name} takes {", ".join(names) or "nothing"}')
    request = service_class._request_class(**arguments)
    try:
        request._check_types()
        request.serialize(io.BytesIO())     # finds a number that its type cannot hold
    except (genpy.SerializationError, ArithmeticError) as error:
        raise CommandRefused(f'{name}: {error}') from None
    return request


def _reply(service: Service, response: Any) -> List[Tuple[str, str]]:
    """The fields of a response that an outcome does not fill: name and value as text."""
    if service.setting:
        return [(service.setting.name, str(value_in(response, service.setting)))]
    known = outcome_fields(type(response))
    return [(each.name, one_line(each.text())[:_MAX_REPLY_TEXT]) for each in islice(
        (leaf for name in response.__slots__ if name not in known
         for leaf in leaves(name, getattr(response, name))), _MAX_REPLY)]
