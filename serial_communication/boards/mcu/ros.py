"""The mcu link in ROS: its parameters and its topics."""
from functools import partial
from math import inf, nan, pi, radians
from typing import Any, Dict, List, Optional, Tuple, Type

import rospy
from sensor_msgs.msg import Range

from serial_communication.msg import McuStatus, McuStatus2

from ...framing.layout import LayoutMessage
from ...framing.rotation import quaternion
from ...ros.custom_topics import MessageTopics, message_rows, names_of
from ...ros.imu import ImuTopic
from ...ros.interface import LinkOptions, Interface
from ...ros.parameter import MOUNT, PORT, RESET_LINE, Parameter, baud, frame_id, seconds
from ...ros.publishing import publisher, wanted
from ...transport.port import Port
from . import DESCRIPTION, settings, wire
from .link import McuLink

_NOT_CONNECTED = 0xFFFF   # in place of a reading; no sensor measures it
_MISSING = 1.0            # s that a value is missing or back before it is logged


class McuInterface(Interface):
    """Publishes measurements, and the status of a silent board."""

    NAME = DESCRIPTION.name
    PARAMETERS = {
        'port': PORT,
        'baud': baud(DESCRIPTION),
        'reset_line': RESET_LINE._replace(default='rts'),
        'timeout': seconds(1.0, 0.01, 3600.0),
        'network_silence': seconds(5.0, 0.0, 3600.0),
        'yaw_clockwise': Parameter(True),
        'messages': Parameter({}, parse=partial(message_rows, DESCRIPTION)),
        'settings': Parameter({}, parse=settings),
        'announcements': Parameter(True),
        'board_time': Parameter(True),
        'roll_pitch_stdev': Parameter(radians(1.0), 0.0, pi, unit='rad'),
        'yaw_stdev': Parameter(radians(5.0), 0.0, pi, unit='rad'),
        'min_range': Parameter(0.03, 0.0, 65.0, unit='m'),
        'max_range': Parameter(2.0, 0.0, 65.0, unit='m'),
        'field_of_view': Parameter(radians(25.0), 0.0, pi, unit='rad'),
        'imu_frame_id': frame_id('mcu_imu'),
        'imu_orientation_frame_id': frame_id('mcu_imu_orientation'),
        'range_1_frame_id': frame_id('range_1'),
        'range_2_frame_id': frame_id('range_2'),
        'imu_mount': MOUNT,
        'range_1_mount': MOUNT,
        'range_2_mount': MOUNT,
    }
    MOUNTS = ('imu', 'range_1', 'range_2')
    link: McuLink

    def __init__(self, parameters: Dict[str, Any], link_options: LinkOptions) -> None:
        p = parameters
        self._turn = -1.0 if p['yaw_clockwise'] else 1.0
        self._ranges = [(publisher(f'mcu/range_{number}', Range), _range(p, number))
                        for number in (1, 2)]
        self._status = publisher('mcu/status', McuStatus2)
        self._adc_status = publisher('mcu/adc_status', McuStatus)
        self._imu = ImuTopic('mcu/imu', p)
        self._missing = self._logged = ''    # the sensors without a value, now and in the log
        self._missing_since = 0.0
        self._topics = MessageTopics(DESCRIPTION, p)
        self.link = McuLink(Port(p['port'], p['baud']), p['timeout'],
                            on_status=self._received, on_silence=self._silent,
                            network_silence=p['network_silence'],
                            messages=self._topics.custom_kinds, board_time=p['board_time'],
                            **link_options._asdict())
        for row in p['settings']:
            self.link.session.board_settings.add(row)
        if p['announcements']:
            self.announced = self._topics.announced(self.link)

    @staticmethod
    def problem(parameters: Dict[str, Any]) -> str:
        low, high = parameters['min_range'], parameters['max_range']
        return '' if low < high else \
            f'min_range is {low:g} m, has to be less than mcu/max_range, which is {high:g} m'

    @staticmethod
    def custom_names(parameters: Dict[str, Any]) -> List[Tuple[str, str]]:
        return names_of(parameters['messages'], 'mcu/')

    def _received(self, message: Any, seq: int, stamp: rospy.Time) -> None:
        if message.TYPE not in wire.MESSAGES:
            self._topics.publish(message, stamp)
            return
        now = self.link.now()
        age = now - (self.link.session.presence.frame_at or now)
        if type(message) is wire.AdcStatus:
            if wanted(self._adc_status):
                self._adc_status.publish(stamp, seq, True, True, self.link.session.checksum_errors, age,
                                         *message)
            return
        self._log_missing(message.missing, now)
        if wanted(self._status):
            self._status.publish(stamp, seq, True, message.valid, self.link.session.checksum_errors, age,
                                 *message)
        for (topic, out), millimetres in zip(self._ranges, message[:2]):
            if wanted(topic):
                out.header.stamp = stamp
                out.range = _metres(millimetres, out.min_range, out.max_range)
                topic.publish(out)
        if message.angles_known and self._imu.is_wanted:
            self._imu.publish(stamp, quaternion(radians(message.roll), radians(message.pitch),
                                                radians(message.yaw) * self._turn))

    def _log_missing(self, missing: str, now: float) -> None:
        if missing != self._missing:
            self._missing, self._missing_since = missing, now
        if missing == self._logged or now < self._missing_since + _MISSING:
            return
        self._logged = missing
        if missing:
            self.link.log.warn('missing', f'no value of {missing}: the board starts such a sensor '
                               'again every second; check its wires')
        else:
            self.link.log.info('complete', 'all sensors have values again')

    def _silent(self, kind: Optional[Type[LayoutMessage]], seq: int, age: float) -> None:
        if kind and kind.TYPE not in wire.MESSAGES:
            return      # custom messages have no status: their topics are silent, too
        head = (rospy.Time.now(), seq, False, False, self.link.session.checksum_errors, age)
        if kind is wire.AdcStatus:
            self._adc_status.publish(*head, *[_NOT_CONNECTED] * 6)
        else:
            self._status.publish(*head, _NOT_CONNECTED, _NOT_CONNECTED, nan, nan, nan)


def _metres(millimetres: int, low: float, high: float) -> float:
    """A range as REP 117 defines it: NaN for no reading, -Inf or +Inf beyond the limits."""
    if millimetres == wire.RANGE_TIMED_OUT:
        return nan
    metres = millimetres / 1000
    return -inf if metres < low else inf if metres > high else metres


def _range(p: Dict[str, Any], number: int) -> Range:
    message = Range(radiation_type=Range.INFRARED, field_of_view=p['field_of_view'],
                    min_range=p['min_range'], max_range=p['max_range'])
    message.header.frame_id = p[f'range_{number}_frame_id']
    return message


INTERFACE = McuInterface
