"""The wind sensor in ROS: publishes the wind on `wind` (geometry_msgs/Vector3Stamped)."""
from math import cos, radians, sin

from geometry_msgs.msg import Vector3Stamped

from serial_communication.link.session import Session
from serial_communication.ros.binder import Binder
from serial_communication.ros.logs import sparing_log
from serial_communication.ros.parameters import frame_id
from serial_communication.ros.publishing import has_subscribers, publisher

from . import DESCRIPTION
from .wire import Decoder, Wind


class WindSession(Session):
    """Receives sentences and sends nothing."""

    NAME = DESCRIPTION.name

    def __init__(self, log, on_wind) -> None:
        super().__init__(Decoder(), log)
        self._on_wind = on_wind

    def received(self, frame, now: float) -> None:
        if isinstance(frame.message, Wind):
            self._on_wind(frame.message, frame.stamp)


class BoardBinder(Binder):
    """See the module."""

    BOARD = DESCRIPTION
    PARAMETERS = {'frame_id': frame_id('wind')}     # besides those that every board has

    def __init__(self, parameters) -> None:
        self._message = Vector3Stamped()
        self._message.header.frame_id = parameters['frame_id']
        self._topic = publisher('wind', Vector3Stamped)
        super().__init__(WindSession(sparing_log(DESCRIPTION.name), self._publish), parameters)

    def _publish(self, wind: Wind, stamp) -> None:
        if has_subscribers(self._topic):
            self._message.header.stamp = stamp
            self._message.vector.x = -wind.speed * cos(radians(wind.angle))
            self._message.vector.y = wind.speed * sin(radians(wind.angle))
            self._topic.publish(self._message)
