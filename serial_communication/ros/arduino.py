"""Topics and the service of the arduino link."""
from typing import Any, Dict, Optional

import rospy
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool, String
from std_srvs.srv import Empty, EmptyResponse

from serial_communication.msg import (SpeedPWMCommand, SteeringFeedback, SteeringPWMCommand,
                                      Ticks, Voltage)

from ..links.arduino import ArduinoLink, ArduinoSettings
from ..links.link import Refused
from ..links.port import Port
from ..protocols import arduino
from .geometry import OrientationBroadcaster
from .publishing import diagonal, publisher, wanted

_SAY = (rospy.logdebug, rospy.loginfo, rospy.logwarn, rospy.logerr)


class ArduinoInterface:
    """Commands in, measurements out."""

    def __init__(self, parameters: Dict[str, Any], **link_arguments) -> None:
        p = parameters
        self._gyro_scale = p['arduino/gyro_scale']
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
        # Each message that becomes one value on one topic: a line here is all it takes.
        self._values = {
            arduino.Voltage: (publisher('~voltage', Voltage), Voltage()),
            arduino.Ticks: (publisher('~ticks', Ticks), Ticks()),
            arduino.SteeringAngle: (publisher('~steering_angle', SteeringFeedback),
                                    SteeringFeedback()),
        }
        self.link = ArduinoLink(
            Port(p['arduino/port'], p['arduino/baud'], p['arduino/reset_on_open']),
            ArduinoSettings(p['arduino/heartbeat_rate'], p['arduino/speed_timeout'],
                            p['arduino/calibration_timeout'], p['arduino/check_plausibility']),
            on_message=self._received, on_log=self._log,
            on_calibrating=lambda on: self._calibrating.publish(on), **link_arguments)

    def advertise(self) -> None:
        """Take commands and offer the service."""
        link = self.link
        for name, message_class, command in (
                ('speed', SpeedPWMCommand, lambda message: link.set_speed(message.value)),
                ('steering', SteeringPWMCommand,
                 lambda message: link.set_steering(message.value)),
                ('led', String, lambda message: link.set_led(message.data))):
            rospy.Subscriber('~' + name, message_class, self._take, (name, command),
                             queue_size=10, tcp_nodelay=True)
        rospy.Service('~calibrate_imu', Empty, self._calibrate)

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
        topic, out = self._values[type(message)]
        if wanted(topic):
            out.header.stamp = stamp
            out.value = message.value
            topic.publish(out)

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
