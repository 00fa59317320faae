"""Topics and the service of the arduino link."""
from typing import Any, Dict, Optional

import rospy
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool, String
from std_srvs.srv import Empty, EmptyResponse

from serial_communication.msg import (SpeedPWMCommand, SteeringFeedback, SteeringPWMCommand,
                                      Ticks, Voltage)

from ..links.arduino import ArduinoLink, ArduinoSettings
from ..links.heart import clock
from ..links.lateness import Lateness
from ..links.link import Refused
from ..transport.port import Port
from ..protocols import arduino
from .geometry import OrientationBroadcaster
from .publishing import diagonal, publisher, wanted
from .rows import built_in_topic, own_topics, take_commands

_SAY = (rospy.logdebug, rospy.loginfo, rospy.logwarn, rospy.logerr)


class ArduinoInterface:
    """Commands in, measurements out."""

    def __init__(self, parameters: Dict[str, Any], **link_arguments) -> None:
        p = parameters
        self._gyro_scale = p['arduino/gyro_scale']
        self._speed_timeout = p['arduino/speed_timeout']
        self._imu_message = _imu(p)
        self._temperature_message = Temperature()
        self._temperature_message.header.frame_id = p['arduino/imu_frame_id']
        self._orientation: Optional[OrientationBroadcaster] = None
        if p['publish_tf']:
            self._orientation = OrientationBroadcaster(p['arduino/imu_frame_id'],
                                                       p['arduino/imu_orientation_frame_id'])
        self._imu = publisher('~imu', Imu)
        self._temperature = publisher('~imu/temperature', Temperature)
        self._calibrating = publisher('~imu/calibrating', Bool, latch=True)
        self._calibrating.publish(False)
        # Each message that is a row on one topic: a line here is all it takes.
        self._rows = {kind: built_in_topic(name, ros_class, kind) for kind, name, ros_class in (
            (arduino.Voltage, '~voltage', Voltage), (arduino.Ticks, '~ticks', Ticks),
            (arduino.SteeringAngle, '~steering_angle', SteeringFeedback))}
        without = set(arduino.FROM_BOARD) - set(self._rows) - {arduino.Imu}
        if without:
            raise TypeError(f'messages without a topic: {without}')
        self._own = p['arduino/messages']
        self._rows.update(own_topics(self._own, '~', p['frame_prefix']))
        self.link = ArduinoLink(
            Port(p['arduino/port'], p['arduino/baud'], p['arduino/reset_on_open']),
            ArduinoSettings(p['arduino/heartbeat_rate'], p['arduino/speed_timeout'],
                            p['arduino/calibration_timeout'], p['arduino/check_plausibility'],
                            p['arduino/network_silence']),
            messages=[kind for kind in self._rows if kind not in arduino.FROM_BOARD],
            on_message=self._received, on_log=self._log,
            on_calibrating=lambda on: self._calibrating.publish(on), **link_arguments)

    def advertise(self) -> None:
        """Take commands and offer the service."""
        link = self.link
        for name, message_class, command in (
                ('speed', SpeedPWMCommand, lambda message: link.set_speed(message.value)),
                ('steering', SteeringPWMCommand,
                 lambda message: link.set_steering(message.value))):
            # Of those that wait only the newest counts: rospy reads all that its socket has, and
            # keeps as many as the queue holds.
            rospy.Subscriber('~' + name, message_class, self._take_newest,
                             (name, command, Lateness(self._speed_timeout)),
                             queue_size=1, tcp_nodelay=True)
        rospy.Subscriber('~led', String, self._take,
                         ('led', lambda message: link.set_led(message.data)),
                         queue_size=10, tcp_nodelay=True)
        take_commands(self._own, '~', link)
        rospy.Service('~calibrate_imu', Empty, self._calibrate)

    def _take_newest(self, message, name_command_and_lateness) -> None:
        name, command, lateness = name_command_and_lateness
        connection = message._connection_header     # one object for each
        sender = connection['callerid']
        late = lateness.of(sender, connection, message.header.stamp.to_sec(), _now())
        if late:
            self.link.log.warn(
                name + ' late', f'{name} {message.value} refused: it is {late:.3g} s late by its '
                f'stamp, from {sender}; is its network slow, or was its clock set?')
            return
        self._take(message, (name, command))

    def _take(self, message, name_and_command) -> None:
        name, command = name_and_command
        try:
            command(message)
        except Refused as refused:
            self.link.log.warn('%s refused: %s' % (name, refused.cause), str(refused))

    def _calibrate(self, _request) -> EmptyResponse:
        try:
            self.link.calibrate_imu()
        except Refused as refused:
            raise rospy.ServiceException(str(refused)) from None
        return EmptyResponse()

    def _received(self, message: Any, stamp: rospy.Time) -> None:
        if type(message) is arduino.Imu:
            self._publish_imu(message, stamp)
            return
        self._rows[type(message)].publish(message, stamp)

    def _publish_imu(self, message: arduino.Imu, stamp: rospy.Time) -> None:
        if wanted(self._imu):
            out = self._imu_message
            out.header.stamp = stamp
            (out.orientation.x, out.orientation.y, out.orientation.z,
             out.orientation.w) = message.orientation()
            (out.angular_velocity.x, out.angular_velocity.y,
             out.angular_velocity.z) = message.angular_velocity(self._gyro_scale)
            (out.linear_acceleration.x, out.linear_acceleration.y,
             out.linear_acceleration.z) = message.linear_acceleration()
            self._imu.publish(out)
        if wanted(self._temperature):
            self._temperature_message.header.stamp = stamp
            self._temperature_message.temperature = message.temperature()
            self._temperature.publish(self._temperature_message)
        if self._orientation:
            self._orientation.send(message.orientation(), stamp)

    @staticmethod
    def _log(severity: int, text: str) -> None:
        _SAY[severity]('arduino says: %s', text)


def _now() -> float:
    """Seconds to compare stamps with: simulated where stamps are, else of no clock that is set."""
    return clock() if rospy.rostime.is_wallclock() else rospy.get_time()


def _imu(p: Dict[str, Any]) -> Imu:
    message = Imu()
    message.header.frame_id = p['arduino/imu_frame_id']
    level, yaw = p['arduino/roll_pitch_stdev'] ** 2, p['arduino/yaw_stdev'] ** 2
    rate = p['arduino/angular_velocity_stdev'] ** 2
    acceleration = p['arduino/linear_acceleration_stdev'] ** 2
    message.orientation_covariance = diagonal(level, level, yaw)
    message.angular_velocity_covariance = diagonal(rate, rate, rate)
    message.linear_acceleration_covariance = diagonal(acceleration, acceleration, acceleration)
    return message
