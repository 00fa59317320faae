"""Subscribes to commands, and takes none that may be old.

A command can have waited anywhere: in a publisher that latches it, in a network that was cut, in
the connection of a process that is dead. Nothing is learned from the commands themselves: each one
is judged by its connection and its stamp alone.
"""
import threading
from typing import Any, Callable, Dict, Optional, Set

import rosgraph
import rospy

from ..link.link import Refused
from ..link.sparing_log import SparingLog

_REMEMBERED = 1000    # names of publishers; each call of rostopic has one of its own


class CommandTopic:
    """The commands of one topic: each is sent, or refused with a warning.

    - Of the connections of one publisher's name only the newest is listened to: on an older one the
      network delivers what a dead process wrote.
    - The first message on a connection of a publisher that latches may be hours old. It is refused
      if that publisher was there before this subscription, or has been heard before.
    - A stamp may not differ from ROS time by more than `age_limit`.

    Args:
        name: of the topic, as ``~speed``.
        message_class: of its messages.
        send: sends one to the board; Refused or ValueError where it cannot.
        label: what one is called in a warning, as ``speed 300``.
        log: of the link.
        age_limit: s; 0: stamps are not looked at.
        queue_size: how many that wait count; the newest ones.
        stops: whether one can only stop the car: it is sent whatever its stamp, latched or not.
    """

    def __init__(self, name: str, message_class: Any, send: Callable[[Any], None],
                 label: Callable[[Any], str], log: SparingLog, age_limit: float,
                 queue_size: int = 10,
                 stops: Callable[[Any], bool] = lambda message: False) -> None:
        self._name = name.lstrip('~')
        self._topic = rospy.resolve_name(name)
        self._send = send
        self._label = label
        self._log = log
        self._age_limit = age_limit if message_class._has_header else 0.0
        self._stops = stops
        self._heard: Dict[str, Any] = {}    # the connection by publisher, the last one heard last
        self._replaced: Dict[int, Any] = {}     # connections that have newer ones, by their ids
        self._there_before = _publishers(self._topic)
        self._impl: Any = None
        self._lock = threading.RLock()      # each connection has a thread; they wait for `_impl`
        with self._lock:
            self._impl = rospy.Subscriber(name, message_class, self._take, queue_size=queue_size,
                                          tcp_nodelay=True).impl

    def _take(self, message: Any) -> None:
        try:
            with self._lock:
                if self._impl is None:
                    return      # by the subscribing thread: a repetition of what a connection's has
                self._refuse_if_old(message)
            self._send(message)
        except Refused as refused:
            self._log.warn(f'{self._name} refused: {refused.cause}', str(refused))
        except ValueError as error:
            self._log.warn(f'{self._name} refused', f'{self._name} refused: {error}')

    def _refuse_if_old(self, message: Any) -> None:
        connection = message._connection_header     # one object for each connection
        sender = connection.get('callerid', '')
        if self._is_replaced(connection, sender):
            raise Refused(f'{self._label(message)} refused: it came on an old connection of '
                          f'{sender}; only the newest one to {self._topic} is listened to',
                          'old connection')
        known = sender in self._heard
        is_first = self._heard.pop(sender, None) is not connection
        self._heard[sender] = connection
        if len(self._heard) > _REMEMBERED:
            del self._heard[next(iter(self._heard))]
        if self._stops(message):
            return
        if is_first and connection.get('latching') == '1' \
                and (known or self._was_there_before(sender)):
            raise Refused(
                f'{self._label(message)} refused: {sender} latches {self._topic} and has '
                f'{"connected again" if known else "done so since before the bridge subscribed"}, '
                'so this may be old; publish it again, with rostopic by "pub -1" or at a rate, '
                '"pub -r 10"', 'latched')
        self._refuse_by_stamp(message, sender)

    def _is_replaced(self, connection: Any, sender: str) -> bool:
        """Whether the publisher has made a newer one since; also where that has gone again."""
        # rospy keeps them in the order in which it made them; without a header, one is being made.
        alive = [each.header for each in self._impl.connections if each.header]
        older = [each for each in alive if each.get('callerid', '') == sender][:-1]
        ids = {id(each) for each in alive}
        self._replaced = {id(each): each for each in (*self._replaced.values(), *older)
                          if id(each) in ids}
        return id(connection) in self._replaced or id(connection) not in ids

    def _was_there_before(self, sender: str) -> bool:
        return self._there_before is None or sender in self._there_before

    def _refuse_by_stamp(self, message: Any, sender: str) -> None:
        stamp = message.header.stamp.to_sec() if self._age_limit else 0.0
        age = rospy.get_time() - stamp
        if stamp and abs(age) > self._age_limit:
            raise Refused(
                f'{self._label(message)} refused: its stamp is {abs(age):.2f} s '
                f'{"old" if age > 0 else "ahead of the time here"}, command_age allows '
                f'{self._age_limit:g} s; is the network from {sender} slow, or its clock wrong? '
                'The clocks of all hosts must agree (chrony)', 'stamp')


def _publishers(topic: str) -> Optional[Set[str]]:
    """Who publishes it, as the master knows; None if the master does not answer."""
    try:
        published = rosgraph.Master(rospy.get_name()).getSystemState()[0]
    except Exception:  # pylint: disable=broad-except
        return None     # whatever a master that is ending, or no master at all, may answer
    return {node for name, nodes in published if name == topic for node in nodes}
