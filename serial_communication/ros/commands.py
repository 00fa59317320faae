"""Subscriptions to commands that refuse commands which may be old.

A command can wait in many places: at a publisher that latches it, in a network that is cut, in the
connection of a dead process. Whether it may be old is judged by its connection and its stamp alone,
never by earlier commands.
"""
import threading
from typing import Any, Dict, Optional, Set

import rosgraph
import rospy

from ..link.outcome import Refused
from .rows import RosRow

_WAITING = 10               # commands that may wait, of a row of which not only the newest counts
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
        link: whose writer sends the commands.
        age_limit: s; 0 ignores the stamps.
    """

    def __init__(self, ros_row: RosRow, link: Any, age_limit: float) -> None:
        row = ros_row.row
        self._row, self._fields, self._link = row, ros_row.fields, link
        self._topic = rospy.resolve_name(ros_row.name)
        # With it nothing moves: sent whatever its stamp is, and whether it was latched or not.
        self._zero = row.zero if row.motion else None
        self._age_limit = age_limit if ros_row.ros_class._has_header else 0.0
        self._known: Dict[str, None] = {}   # names of publishers; the last to send comes last
        self._older_publishers = _publishers(self._topic)
        self._lock = threading.RLock()      # each connection has a thread; they wait for that
        self._subscriber: Any = None        # None: not subscribed yet, or closed
        with self._lock:
            self._subscriber = rospy.Subscriber(
                ros_row.name, ros_row.ros_class, self._received,
                queue_size=1 if row.newest else _WAITING, tcp_nodelay=True)

    def close(self) -> None:
        """Unsubscribe; messages that are received later are ignored."""
        with self._lock:
            subscriber, self._subscriber = self._subscriber, None
        subscriber.unregister()

    def _received(self, message: Any) -> None:
        name, log = self._row.name, self._link.log
        try:
            values = self._fields.read(message)
            if self._row.motion:
                values, why = self._row.saturated(values)
                if why:
                    log.warn(f'{name} saturated', why)
            command = self._row.message(*values)
        except ValueError as error:
            log.warn(f'{name} refused', f'{name} refused: {error}')
            return
        stamp = getattr(getattr(message, 'header', None), 'stamp', None) or None
        try:
            with self._lock:
                if self._subscriber is None:
                    return      # while subscribing: the connection's thread handles it later
                self._refuse_if_old(message, command)
                self._link.writer.submit(command, stamp)     # before `close` returns
        except Refused as refused:
            log.warn(f'{name} refused: {refused.cause}',
                     f'{str(command)[:_LABEL]} refused: {refused}')

    def _refuse_if_old(self, message: Any, command: Any) -> None:
        connection = message._connection_header     # one object for each connection
        sender = connection.get('callerid', '')
        # rospy keeps them in the order in which it made them; one without a header is not ready.
        alive = [each.header for each in self._subscriber.impl.connections if each.header]
        for older in [each for each in alive if each.get('callerid', '') == sender][:-1]:
            older[_REPLACED] = 'yes'        # and stays so when the newer one has closed
        if _REPLACED in connection or all(each is not connection for each in alive):
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
