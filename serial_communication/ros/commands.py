"""Subscriptions to commands that refuse commands which may be old.

A command can wait in many places: at a publisher that latches it, in a network that is cut, in the
connection of a dead process. Whether it may be old is judged by its connection and its stamp alone,
never by earlier commands.
"""
import threading
from typing import Any, Callable, Dict, Optional, Set

import rosgraph
import rospy

from ..link.link import Refused
from ..link.sparing_log import SparingLog

_LABEL = 100                # characters of a command in a warning
_MOST_PUBLISHERS = 1000     # names to remember; each call of rostopic has a new one
# Marks that are kept in the header of a connection, which lives as long as that:
_REPLACED, _HAS_SENT = 'serial_communication: replaced', 'serial_communication: has sent'


class CommandTopic:
    """A subscription whose messages are sent to the board, or refused with a warning.

    - Only the newest connection of each publisher's name is used. On an older one the network still
      delivers what a dead process wrote.
    - The first message on a connection of a publisher that latches may be hours old. It is refused
      if that publisher is older than this subscription, or has connected before.
    - A stamp may differ from ROS time by `age_limit` at most.

    Args:
        name: topic, such as ``~speed``.
        message_class: class of its messages.
        read: returns the command in a message; ValueError if it is none.
        send: sends a command to the board; raises Refused if it cannot.
        zero: the command with which nothing moves: sent whatever its stamp is, and whether it was
            latched or not. None: there is none.
        log: log of the link.
        age_limit: s; 0 ignores the stamps.
        queue_size: how many of the newest messages may wait.
    """

    def __init__(self, name: str, message_class: Any, read: Callable[[Any], Any],
                 send: Callable[[Any, Any], None], zero: Any, log: SparingLog, age_limit: float,
                 queue_size: int) -> None:
        self._name = name.lstrip('~')
        self._topic = rospy.resolve_name(name)
        self._read, self._send, self._zero = read, send, zero
        self._log = log
        self._age_limit = age_limit if message_class._has_header else 0.0
        self._known: Dict[str, None] = {}   # names of publishers; the last to send comes last
        self._older_publishers = _publishers(self._topic)
        self._lock = threading.RLock()      # each connection has a thread; they wait for that
        self._subscriber: Any = None        # None: not subscribed yet, or closed
        with self._lock:
            self._subscriber = rospy.Subscriber(name, message_class, self._received,
                                                queue_size=queue_size, tcp_nodelay=True)

    def close(self) -> None:
        """Unsubscribe; messages that are received later are ignored."""
        with self._lock:
            subscriber, self._subscriber = self._subscriber, None
        subscriber.unregister()

    def _received(self, message: Any) -> None:
        try:
            command = self._read(message)
        except ValueError as error:
            self._log.warn(f'{self._name} refused', f'{self._name} refused: {error}')
            return
        stamp = getattr(getattr(message, 'header', None), 'stamp', None) or None
        try:
            with self._lock:
                if self._subscriber is None:
                    return      # while subscribing: the connection's thread handles it later
                self._refuse_if_old(message, command)
                self._send(command, stamp)     # before `close` returns
        except Refused as refused:
            self._log.warn(f'{self._name} refused: {refused.cause}',
                           f'{str(command)[:_LABEL]} refused: {refused}')

    def _is_replaced(self, header: Dict[str, str]) -> bool:
        """Whether the publisher has made a newer connection, even if that has closed."""
        # rospy keeps them in the order in which it made them. One without a header is not ready.
        alive = [each.header for each in self._subscriber.impl.connections if each.header]
        sender = header.get('callerid', '')
        older = [each for each in alive if each.get('callerid', '') == sender][:-1]
        for each in older:
            each[_REPLACED] = 'yes'
        return _REPLACED in header or all(each is not header for each in alive)

    def _refuse_if_old(self, message: Any, command: Any) -> None:
        connection = message._connection_header     # one object for each connection
        sender = connection.get('callerid', '')
        if self._is_replaced(connection):
            raise Refused(f'it was received on an old connection of {sender}; only the newest '
                          f'connection to {self._topic} is used', 'old connection')
        known = sender in self._known
        is_first = _HAS_SENT not in connection
        connection[_HAS_SENT] = 'yes'
        self._known.pop(sender, None)
        self._known[sender] = None
        if len(self._known) > _MOST_PUBLISHERS:
            del self._known[next(iter(self._known))]
        if command == self._zero:
            return
        if is_first and connection.get('latching') == '1' \
                and (known or self._older_publishers is None
                     or sender in self._older_publishers):
            raise Refused(
                f'{sender} latches {self._topic} and '
                f'{"has connected again" if known else "is older than the subscription"}, so the '
                'message may be old; publish it again with "rostopic pub -1", or at a rate with '
                '"rostopic pub -r 10"', 'latched')
        stamp = message.header.stamp.to_sec() if self._age_limit else 0.0
        age = rospy.get_time() - stamp
        if stamp and abs(age) > self._age_limit:
            raise Refused(
                f'its stamp is {abs(age):.2f} s {"old" if age > 0 else "in the future"}, '
                f'command_age allows {self._age_limit:g} s; is the network from {sender} slow, or '
                'its clock wrong? The clocks of all hosts must agree (chrony)', 'stamp')


def _publishers(topic: str) -> Optional[Set[str]]:
    """Return the names of the topic's publishers; None if the master does not answer."""
    try:
        published = rosgraph.Master(rospy.get_name()).getSystemState()[0]
    except Exception:  # pylint: disable=broad-except
        return None     # a master that is ending, or another server, may answer anything
    return {node for name, nodes in published if name == topic for node in nodes}
