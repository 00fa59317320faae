"""The rows of a board in ROS: topics, subscriptions, services, polls and settings.

`Binder.sync` makes and takes down what changed: at the start, and with each announcement. After the
start all of that happens in the thread of one LatestWorker for all links, since rospy and the
master may take any time.
"""
import threading
from contextlib import ExitStack
from functools import partial
from typing import Any, Dict, Iterable, List, Sequence, Tuple, Type

import rospy

from ..boards.description import ANNOUNCED_GROUP, Description
from ..framing.announcement import read_announcement
from ..framing.rows import FILE, Kind, RowError, refuse_second_number
from ..link.link import Link
from ..link.outcome import NOT_SENT, Outcome
from ..link.session import Session
from ..transport.port import Port
from .background import LatestWorker
from .commands import CommandTopic
from .fields import fill_response
from .publishing import MessageTopic
from .rows import ODOMETRY, RosRow, resolve, rows_in
from .settings import SettingsServer, for_xml_rpc


class RowTopic(MessageTopic):
    """Publishes tuples of values as messages of one ROS type, while the topic has subscribers.

    A message is left out if one of its values is "no value" and its field cannot be NaN. The pose
    of a nav_msgs/Odometry is on /tf, too, if the parameters say so.
    """

    def __init__(self, ros_row: RosRow, p: Dict[str, Any]) -> None:
        row, self._fields = ros_row.row, ros_row.fields
        self._lock = threading.Lock()     # held while a message is published or the topic closed
        message = self._fields.new()
        if row.frame_id:
            message.header.frame_id = p['frame_prefix'] + row.frame_id
        if row.child_frame_id:
            message.child_frame_id = p['frame_prefix'] + row.child_frame_id
        has_pose = row.child_frame_id and p['publish_tf'] and message._type == ODOMETRY
        super().__init__(ros_row.name, message, *(
            (message.pose.pose, message.child_frame_id) if has_pose else ()))

    def send(self, values: Sequence, stamp: rospy.Time) -> None:
        """Publish a message with these values; do nothing once it is closed."""
        with self._lock:
            if self.has_subscribers and not self._fields.lacks(values):
                self._fields.fill(self.message, values)
                self.publish(stamp)

    def close(self) -> None:
        """Unregister the topic; may be called from any thread, at any time."""
        with self._lock:
            topics, self.topics = self.topics, []
        for topic in topics:
            topic.unregister()


class Binder:
    """One board in ROS: its link, and its rows: built in, of the parameters, and announced.

    The module `ros` of a board has a subclass `BoardBinder`, which adds its own parameters, what no
    row describes, and the session. The node checks the parameters, creates the binder if the board
    has a port, publishes its mounts, and starts its link.

    Args:
        p: the checked values of `parameters_of` this class, and those of the node. Frame ids have
            the prefix already.
    """

    BOARD: Description
    # Besides those that every board has. For a sensor x, x_frame_id and x_mount are its mount.
    PARAMETERS: Dict[str, Any] = {}
    LINK: Type[Link] = Link

    def __init__(self, session: Session, p: Dict[str, Any]) -> None:
        port = Port(p['port'], p['baud'], p.get('reset_on_open', False))
        self.link: Any = self.LINK(port, session, p['frame_timeout'], rospy.Time.now, _earlier,
                                   p.get('board_time', True))
        self.link.lending.reset_line = p['reset_line']
        self._p = p
        # Of the parameters and built in. They take precedence over announced ones.
        self._fixed = [*(resolve(self.BOARD, row) for row in self.BOARD.rows), *rows_in(p)]
        self._made: Dict[str, Tuple[RosRow, ExitStack]] = {}     # and what takes it down
        self._topics: Dict[Any, RowTopic] = {}     # by class of the message

    def serve(self, worker: LatestWorker, names: Dict[str, str], values: Dict[str, Any]) -> None:
        """Make the rows of the start; those that the board announces follow in the worker's thread.

        Args:
            names: the resolved names of topics and services, and whose each is; for all links.
            values: of settings, that are wanted at the start.
        """
        self._names = names     # of announced rows, too
        if self.link.session.board_settings:
            SettingsServer(self.link, values, worker)
        self.sync(self._fixed)
        if self._p['announcements'] and self.BOARD.groups:
            self.link.session.announcement.on_text = partial(worker.submit, self._announced)

    def publish(self, message: Any, stamp: rospy.Time) -> None:
        """Publish a message of the board; do nothing if its row was just taken down."""
        topic = self._topics.get(type(message))
        if topic:
            topic.send(message, stamp)

    def sync(self, rows: Iterable[RosRow]) -> None:
        """Have exactly these rows in ROS. Nobody notices it of one that is there already."""
        rows_by_name = {each.name: each for each in rows}
        for name, (ros_row, made) in list(self._made.items()):
            if name not in rows_by_name or rows_by_name[name].row != ros_row.row:
                del self._made[name], self._names[rospy.resolve_name(name)]
                made.close()
        for name, each in rows_by_name.items():
            if name not in self._made:
                self._made[name] = each, self._make(each)
                self._names[rospy.resolve_name(name)] = each.row.key or name

    # -- announcements -------------------------------------------------------------------------

    def _announced(self, text: bytes) -> None:
        """Use the rows that the board announces, as far as they may be."""
        announcement = read_announcement(text)
        for line in announcement.problems:
            self.link.log.warn('', line)
        accepted = self._accepted(announcement.rows)
        self.sync(self._fixed + accepted)
        names, firmware = [each.row.name for each in accepted], announcement.firmware
        self.link.session.announcement.use(text, firmware, names)
        self.link.log.info('', f'announces {", ".join(names) or "nothing"}'
                           + (f' (firmware {firmware})' if firmware else ''))
        rospy.set_param(f'~{self.link.name}/{ANNOUNCED_GROUP}', for_xml_rpc(
            {name: announcement.rows[name] for name in names}))

    def _accepted(self, given: Dict[str, Any]) -> List[RosRow]:
        """The rows that may be used; a warning says why another may not."""
        accepted: List[RosRow] = []
        for name in given:
            try:
                row = self.BOARD.read_announced(name, given[name])
                other = next((each.row for each in self._fixed if each.row.origin == FILE and (
                    each.name == self.BOARD.name_of(row) or
                    (each.row.number_key, each.row.number) == (row.number_key, row.number))), None)
                if other is None:
                    refuse_second_number(row, [each.row for each in accepted])
                    user = self._names.get(rospy.resolve_name(self.BOARD.name_of(row)), row.key)
                    if user != row.key:
                        raise RowError(row.key, name, f'has the name of {user}')
                    accepted.append(resolve(self.BOARD, row))
                elif other != row:
                    self.link.log.warn('', f'the announced row {name} is left out: the parameter '
                                       f'{other.key} differs, and takes precedence')
            except RowError as error:
                self.link.log.warn('', f'an announced row is left out: {error}')
        return accepted

    # -- one row ---------------------------------------------------------------------------------

    def _make(self, ros_row: RosRow) -> ExitStack:
        """Make a row in ROS; closing what is returned takes it down, the last part first."""
        row, session, made = ros_row.row, self.link.session, ExitStack()
        if row.kind is Kind.SETTING:
            made.callback(session.board_settings.add(row))
        elif row.kind is Kind.TO:
            if row.motion:
                session.add_motion(row.zero)
                made.callback(self.link.writer.write, partial(session.remove_motion, row.zero))
            made.callback(CommandTopic(ros_row, self.link, self._p['command_age']).close)
        elif row.kind is Kind.FUNCTION and not row.period:
            self._offer(ros_row, made)
        else:
            topic = RowTopic(ros_row, self._p)
            made.callback(topic.close)
            if row.kind is Kind.FUNCTION:
                made.callback(session.polls.add(row, row.period, lambda outcome: topic.send(
                    _values(ros_row, outcome), outcome.stamp)))
            else:
                self._topics[row.message] = topic
                made.callback(self._topics.pop, row.message)
                session.decoder.add_message(row.message)
                made.callback(session.decoder.remove_message, row.message)
        return made

    def _offer(self, ros_row: RosRow, made: ExitStack) -> None:
        """Offer a function as a service."""
        row: Any = ros_row.row
        link = self.link

        def handle(ros_request: Any) -> Any:
            try:
                request = row.make_request(ros_row.request.read(ros_request))
            except ValueError as error:
                outcome = Outcome(NOT_SENT, f'{error}; nothing was sent')
            else:
                outcome = link.request(request, row)
            response = fill_response(ros_row.fields.new(), outcome)
            if outcome.success:
                ros_row.fields.fill(response, _values(ros_row, outcome))
            return response

        def forget_stop() -> None:      # any thread may go through the list meanwhile
            link.session.stops = [each for each in link.session.stops if each[1] is not row]

        made.callback(rospy.Service(ros_row.name, ros_row.ros_class, handle).shutdown,
                      'the board announces it no longer')
        if ros_row.stop:
            link.session.stops.append((ros_row.stop, row))
            made.callback(forget_stop)


def _earlier(stamp: rospy.Time, seconds: float) -> rospy.Time:
    """The time so many seconds before `stamp`; ROS has none before 0."""
    return rospy.Time(0, max(stamp.to_nsec() - int(seconds * 1e9), 0))


def _values(ros_row: RosRow, outcome: Outcome) -> Sequence:
    """The values of an OK. Data that is not expected is left out."""
    reply = ros_row.row.reply
    return () if reply.is_empty else reply.unpack(outcome.data)
