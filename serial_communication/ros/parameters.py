"""The node's private parameters: one table says what each is and what it may be.

config/bridge.yaml documents them for users; a test holds the two together.
"""
import difflib
from math import isfinite, pi, radians
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

from ..transport.port import check_url
from ..protocols.arduino import GYRO_SCALE
from ..protocols.own_messages import RowError
from .rows import arduino_rows, bus_rows, mcu_rows, refuse_equal_names


class ParameterError(ValueError):
    """A parameter that cannot be used; the text is one line for a person."""


class Parameter(NamedTuple):
    """One parameter: its type is that of its default."""

    default: Any
    low: float = float('-inf')
    high: float = float('inf')
    choices: Tuple = ()
    unit: str = ''
    parse: Optional[Callable[[Any], Any]] = None    # what makes the value of a group of entries

    def allowed(self) -> str:
        """What it may be, in words."""
        if self.choices:
            return 'may be ' + ' or '.join(repr(choice) for choice in self.choices)
        kind = {bool: 'true or false', str: 'text', int: 'a whole number', float: 'a number',
                list: 'a list of %d numbers' % len(self.default or ())
                if isinstance(self.default, list) else ''}[type(self.default)]
        bounds = ''
        if isfinite(self.low) and isfinite(self.high):
            bounds = ' from %g to %.10g' % (self.low, self.high)
        elif isfinite(self.low):
            bounds = ' of at least %g' % self.low
        return 'may be %s%s%s' % (kind, bounds, ' (%s)' % self.unit if self.unit else '')

    def check(self, value: Any) -> Any:
        """The value in its own type; ValueError if it may not be."""
        if self.parse:
            return self.parse(value)
        wanted = type(self.default)
        if wanted is float and type(value) is int:
            value = float(value)
        if type(value) is not wanted:
            raise ValueError
        if self.choices and value not in self.choices:
            raise ValueError
        if wanted in (int, float) and not self.low <= value <= self.high:
            raise ValueError    # NaN fails this as well
        if wanted is list:
            if len(value) != len(self.default) or not all(
                    type(item) in (int, float) and isfinite(item) for item in value):
                raise ValueError
            value = [float(item) for item in value]
        return value


def _seconds(default: float, low: float, high: float) -> Parameter:
    return Parameter(default, low, high, unit='s')


_PORT = Parameter('')
_BAUD = Parameter(115200, 50, 4000000, unit='baud')
_FRAME = Parameter
_MOUNT = Parameter([0.0] * 6, unit='x y z in m, roll pitch yaw in rad, in base_frame_id')

PARAMETERS: Dict[str, Parameter] = {
    'frame_timeout': _seconds(0.05, 0.001, 10.0),
    'publish_tf': Parameter(False),
    'base_frame_id': _FRAME('base_link'),
    'frame_prefix': Parameter(''),

    'bus/port': _PORT,
    'bus/baud': _BAUD,
    'bus/reply_timeout': _seconds(0.5, 0.01, 60.0),
    'bus/motion_timeout': _seconds(5.0, 0.01, 600.0),
    'bus/retries': Parameter(2, 0, 100),
    'bus/environment_period': _seconds(1.0, 0.0, 86400.0),
    'bus/environment_datelen': Parameter(2, choices=(0, 2)),
    'bus/reply_has_cmd2': Parameter(False),
    'bus/functions': Parameter({}, parse=bus_rows),

    'arduino/port': _PORT,
    'arduino/baud': _BAUD,
    'arduino/reset_on_open': Parameter(False),
    'arduino/heartbeat_rate': Parameter(100.0, 1.0, 1000.0, unit='Hz'),
    'arduino/speed_timeout': _seconds(0.5, 0.0, 3600.0),
    'arduino/network_silence': _seconds(1.0, 0.0, 3600.0),
    'arduino/calibration_timeout': _seconds(900.0, 1.0, 86400.0),
    'arduino/check_plausibility': Parameter(True),
    'arduino/messages': Parameter({}, parse=arduino_rows),
    'arduino/gyro_scale': Parameter(GYRO_SCALE, -1.0, 1.0, unit='rad/s per LSB'),
    'arduino/linear_acceleration_stdev': Parameter(400e-6 * 9.807, 0.0, 1e3, unit='m/s^2'),
    'arduino/angular_velocity_stdev': Parameter(radians(0.05), 0.0, 1e3, unit='rad/s'),
    'arduino/roll_pitch_stdev': Parameter(radians(1.0), 0.0, pi, unit='rad'),
    'arduino/yaw_stdev': Parameter(radians(5.0), 0.0, pi, unit='rad'),
    'arduino/imu_frame_id': _FRAME('imu'),
    'arduino/imu_orientation_frame_id': _FRAME('imu_orientation'),
    'arduino/imu_mount': _MOUNT,

    'mcu/port': _PORT,
    'mcu/baud': _BAUD,
    'mcu/timeout': _seconds(1.0, 0.01, 3600.0),
    'mcu/network_silence': _seconds(5.0, 0.0, 3600.0),
    'mcu/yaw_clockwise': Parameter(True),
    'mcu/messages': Parameter({}, parse=mcu_rows),
    'mcu/roll_pitch_stdev': Parameter(radians(1.0), 0.0, pi, unit='rad'),
    'mcu/yaw_stdev': Parameter(radians(5.0), 0.0, pi, unit='rad'),
    'mcu/min_range': Parameter(0.03, 0.0, 65.0, unit='m'),
    'mcu/max_range': Parameter(2.0, 0.0, 65.0, unit='m'),
    'mcu/field_of_view': Parameter(radians(25.0), 0.0, pi, unit='rad'),
    'mcu/imu_frame_id': _FRAME('mcu_imu'),
    'mcu/imu_orientation_frame_id': _FRAME('mcu_imu_orientation'),
    'mcu/range_1_frame_id': _FRAME('range_1'),
    'mcu/range_2_frame_id': _FRAME('range_2'),
    'mcu/imu_mount': _MOUNT,
    'mcu/range_1_mount': _MOUNT,
    'mcu/range_2_mount': _MOUNT,
}


def check(given: Dict[str, Any], namespace: str) -> Tuple[Dict[str, Any], List[str]]:
    """Every parameter's value, and a warning for each name that is none of the parameters.

    Frame ids come with `frame_prefix` before them.

    Args:
        given: what the parameter server holds under `namespace`, nested as it holds it.

    Raises:
        ParameterError: names the parameter, what it is and what it may be.
    """
    flat = _flatten(given, namespace)
    values = {}
    for name, parameter in PARAMETERS.items():
        value = flat.pop(name, parameter.default)
        try:
            values[name] = parameter.check(value)
            if name.endswith('/port') and values[name]:
                check_url(values[name])
            if name.endswith('frame_id') and not value:
                raise ValueError
        except RowError as error:
            raise ParameterError(f'parameter {namespace}/{error}') from None
        except ValueError as error:
            raise ParameterError('parameter %s/%s is %r (%s), %s%s' % (
                namespace, name, value, type(value).__name__, parameter.allowed(),
                ': %s' % error if str(error) else '')) from None
    if values['mcu/min_range'] >= values['mcu/max_range']:
        raise ParameterError('parameter %s/mcu/min_range is %g, may be less than mcu/max_range, '
                             'which is %g' % (namespace, values['mcu/min_range'],
                                              values['mcu/max_range']))
    try:
        refuse_equal_names(values['arduino/messages'], values['bus/functions'])
    except RowError as error:
        raise ParameterError(f'parameter {namespace}/{error}') from None
    for name in values:
        if name.endswith('frame_id'):
            values[name] = values['frame_prefix'] + values[name]
    return values, [_unknown(namespace, name) for name in sorted(flat)]


def _flatten(given: Any, namespace: str) -> Dict[str, Any]:
    flat = {}
    if not isinstance(given, dict):
        raise ParameterError('parameter %s is %r, may be a group of parameters'
                             % (namespace, given))
    groups = {name.split('/')[0] for name in PARAMETERS if '/' in name}
    for name, value in given.items():
        if name in groups:
            inner = _flatten(value, '%s/%s' % (namespace, name))
            flat.update(('%s/%s' % (name, key), item) for key, item in inner.items())
        else:
            flat[name] = value
    return flat


def _unknown(namespace: str, name: str) -> str:
    near: Optional[List[str]] = difflib.get_close_matches(name, PARAMETERS, 1)
    return 'parameter %s/%s is not known here and has no effect%s' % (
        namespace, name, '; did you mean %s?' % near[0] if near else '')
