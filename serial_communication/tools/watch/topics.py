"""The bridge's topics, and their messages as numbers and text. Imports no ROS.

Numbers and text depend on a message's type, not on its topic's name. So a topic that no board
describes, such as a remapped one, is shown too. A board's description adds the order, the link and
the expected period.
"""
import math
import re
from typing import Any, Dict, Iterable, List, NamedTuple, Optional, Tuple, Union

from ...boards import BOARDS, description, descriptions
from ...boards.description import ANNOUNCED_GROUP, Description
from ...framing.layout import BOARD_TIME
from ...framing.row_reader import Group
from ...simulation.arguments import board_packages, board_parameters

NODE = '/serial_communication'           # the bridge's default name
DIAGNOSTICS = '/diagnostics'
SERIAL_MSG = 'serial_msg'
_OF_ALL_NODES = '/clock', '/diagnostics', '/rosout', '/tf', '/tf_static'
_SETTINGS = '~settings/'      # of dynamic_reconfigure; /diagnostics has the values
_MOST_ITEMS = 16     # of an array that are shown
_UNITS = {'last_frame_age_sec': ('s', 2), 'vl53_1': ('mm', 0), 'vl53_2': ('mm', 0),
          'yaw': ('deg', 1), 'pitch': ('deg', 1), 'roll': ('deg', 1)}      # and digits: of a status


class FieldValue(NamedTuple):
    """One number, flag or text of a message."""

    name: str
    value: Union[float, bool, str]
    unit: str = ''
    digits: Optional[int] = None      # after the decimal point; None: as many as it has
    low: Optional[float] = None       # the least value that a range sensor can measure
    high: Optional[float] = None      # the greatest

    def text(self) -> str:
        """Return the value with its unit."""
        if isinstance(self.value, bool):
            return 'yes' if self.value else 'no'
        if isinstance(self.value, str):
            return self.value
        if self.value != self.value:
            return 'no value'
        if self.digits is not None:
            number = f'{self.value:.{self.digits}f}'
        else:
            number = str(self.value) if isinstance(self.value, int) else f'{self.value:.6g}'
        return f'{number} {self.unit}' if self.unit else number


class BridgeTopic(NamedTuple):
    """A topic that the bridge publishes. `name` is relative to the node: ~imu, mcu/status, /tf."""

    name: str
    type: str                         # the ROS type: package/Type
    links: Tuple[str, ...] = ()       # it carries data if one of these is on; (): not known
    period: Optional[float] = None    # s between two messages; None: measured
    ages: bool = True                 # False: published only on change, so never stale
    optional: bool = False            # only some boards send it
    fields: Tuple[str, ...] = ()      # of a custom message: the `fields` of its row

    def values(self, message: Any) -> List[FieldValue]:
        """Return the numbers, flags and texts of a message of this topic."""
        if self.fields:
            return [value for path in self.fields
                    for value in leaves(path, _follow(message, path))]
        return list(_VALUES.get(self.type, lambda message: leaves('', message))(message))

    def words(self, message: Any) -> str:
        """Return a message of this topic as one line of text."""
        values = self.values(message)
        return one_line(', '.join(f'{value.name} {value.text()}' * (len(values) > 1)
                                  or value.text() for value in values))


def board_topics(board: Description, parameters: Any = None) -> List[BridgeTopic]:
    """Return a board's built-in topics, with the periods from its parameters."""
    own = board_parameters(parameters, board.name)
    return [BridgeTopic(topic.name, topic.type, (board.name,),
                        _number(own.get(topic.period_parameter)) or topic.period,
                        topic.ages, topic.optional) for topic in board.published]


def _number(value: Any) -> Optional[float]:
    return float(value) if isinstance(value, (int, float)) else None


# -- names ---------------------------------------------------------------------------------------


def absolute(name: str, node: str) -> str:
    """Return the absolute name of a name relative to the node: ~imu, mcu/status, /tf."""
    if name.startswith('~'):
        return f'{node}/{name[1:]}'
    return name if name.startswith('/') else _namespace(node) + name


def relative(name: str, node: str) -> str:
    """Return the name relative to the node: the inverse of `absolute`."""
    if name.startswith(node + '/'):
        return '~' + name[len(node) + 1:]
    # A name of another namespace stays absolute; these three are absolute in every namespace.
    inside = _namespace(node)
    if name.startswith(inside) and name not in ('/tf', '/tf_static', DIAGNOSTICS):
        return name[len(inside):]
    return name


def _namespace(node: str) -> str:
    """The namespace of a node: / for /serial_communication, /car/ for /car/bridge."""
    return node.rsplit('/', 1)[0] + '/'


# -- what a bridge publishes ---------------------------------------------------------------------


def boards_of(parameters: Any) -> List[Description]:
    """Return the boards of this package, and those that the parameter `boards` names.

    A board that cannot be imported here is left out. Its topics and frames are still shown.
    """
    found = descriptions()
    for package in board_packages(parameters):
        try:
            found.append(description(str(package)))
        except Exception:  # pylint: disable=broad-except
            pass    # it is not installed here, or its import raises
    return found


def published_topics(node: str, published: Dict[str, str], parameters: Any,
                     boards: Iterable[Description]) -> List[BridgeTopic]:
    """Return the topics of one bridge: those of its boards, in their order, then the others by
    name. Those on which every node publishes are left out.

    Args:
        node: its full name, such as /serial_communication.
        published: the type of each topic that it publishes, by full name.
        parameters: its private parameters, nested as on the parameter server.
        boards: `boards_of` these parameters.
    """
    known = {topic.name: topic for topic in (
        topic for board in boards
        for topic in (*board_topics(board, parameters), *row_topics(board, parameters)))}
    names = {relative(full_name, node): type_ for full_name, type_ in published.items()
             if full_name not in _OF_ALL_NODES
             and not relative(full_name, node).startswith(_SETTINGS)}
    return [known.get(name, BridgeTopic(name, ''))._replace(type=names[name])
            for name in in_order(names, known)]


def in_order(names: Iterable[str], first: Iterable[str] = BOARDS) -> List[str]:
    """Sort names for display: those in `first` in its order, then the others by name."""
    given = set(names)
    return [name for name in dict.fromkeys([*first, *sorted(given)]) if name in given]


def expected_links(parameters: Dict[str, Any]) -> List[str]:
    """Return the links for which the node's parameters set a port."""
    return in_order(name for name in parameters if board_parameters(parameters, name).get('port'))


def given_rows(board: Description, parameters: Any) -> List[Tuple[Group, str, Dict[str, Any]]]:
    """Return the rows of a board, those of its parameters and those that it announces, with their
    groups and names."""
    given = board_parameters(parameters, board.name)
    found = {(group.parameter, name): (group, name, row)
             for rows in (ANNOUNCED_GROUP, *(group.parameter for group in board.groups))
             for name, row in board_parameters(given, rows).items() if isinstance(row, dict)
             for group in [board.group_of(row)] if rows in (ANNOUNCED_GROUP, group.parameter)}
    return list(found.values())


def row_topics(board: Description, parameters: Any) -> List[BridgeTopic]:
    """Return the topics of a board's custom messages and polled functions."""
    return [BridgeTopic(group.prefix + name, str(row['ros_type']), (board.name,),
                        _number(row.get('period')), fields=_fields(row.get('reply', row)))
            for group, name, row in given_rows(board, parameters)
            if 'ros_type' in row and row.get('direction') != 'to_board']


def _fields(row: Any) -> Tuple[str, ...]:
    paths = row.get('fields') if isinstance(row, dict) else None
    return tuple(str(path) for path in paths if path not in ('', BOARD_TIME)) \
        if isinstance(paths, list) else ()


# -- any message ---------------------------------------------------------------------------------


def _follow(message: Any, path: str) -> Any:
    """The part of a message at a path such as vector.x or position[2]; None if there is none."""
    for name, index in re.findall(r'(\w+)(?:\[(\d+)\])?', path):
        message = getattr(message, name, None)
        if index:
            message = message[int(index)] if message and int(index) < len(message) else None
    return message


def leaves(name: str, part: Any) -> Iterable[FieldValue]:
    """Yield each number, flag and text of a message or of a part of one, except headers."""
    if isinstance(part, (bool, int, float, str)):
        yield FieldValue(name, part)
    elif hasattr(part, 'to_sec'):
        yield FieldValue(name, part.to_sec(), 's', 3)
    elif isinstance(part, (list, tuple, bytes)):
        for index, item in enumerate(part[:_MOST_ITEMS]):
            yield from leaves(f'{name}[{index}]', item)
    else:
        for slot in getattr(part, '__slots__', ()):
            if slot != 'header':
                yield from leaves(f'{name}.{slot}' if name else slot, getattr(part, slot))


def one_line(text: str) -> str:
    """Replace control characters and line breaks, which a terminal would obey, by spaces."""
    return ''.join(each if each.isprintable() else ' ' for each in text)


# -- the types of the bridge's built-in topics ---------------------------------------------------


def _imu(message: Any) -> List[FieldValue]:
    q = message.orientation
    angles = (math.atan2(2 * (q.w * q.x + q.y * q.z), 1 - 2 * (q.x * q.x + q.y * q.y)),
              math.asin(max(-1.0, min(1.0, 2 * (q.w * q.y - q.z * q.x)))),
              math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)))
    found = [FieldValue(name, math.degrees(angle), 'deg', 1)
             for name, angle in zip(('roll', 'pitch', 'yaw'), angles)]
    for name, unit, digits in (('angular_velocity', 'rad/s', 3),
                               ('linear_acceleration', 'm/s^2', 2)):
        if getattr(message, name + '_covariance')[0] != -1:      # -1: not measured
            found += [each._replace(unit=unit, digits=digits)
                      for each in leaves(name, getattr(message, name))]
    return found


def _status(message: Any) -> List[FieldValue]:
    """The measurements in a status of the sensor board, and whether they are valid."""
    return [FieldValue(each.name, math.nan if each.name[:4] == 'vl53' and each.value == 65535
                       else each.value, *_UNITS.get(each.name, ())) for each in leaves('', message)
            if each.name not in ('stamp', 'seq', 'connected', 'crc_error_count')]


# Type to numbers. For any other type they are the numbers, flags and texts of its fields.
_VALUES = {
    'sensor_msgs/Imu': _imu,
    'sensor_msgs/Range': lambda m: [
        FieldValue('range', m.range, 'm', 3, m.min_range, m.max_range)],
    'sensor_msgs/RelativeHumidity': lambda m: [
        FieldValue('humidity', m.relative_humidity * 100, '%', 2)],
    'sensor_msgs/Temperature': lambda m: [
        FieldValue('temperature', m.temperature, 'degrees C', 2)],
    'serial_communication/Environment': lambda m: [
        FieldValue('smoke', m.smoke, '', 0),
        FieldValue('temperature', m.temperature, 'degrees C', 2),
        FieldValue('humidity', m.humidity, '%', 2)],
    'serial_communication/McuStatus': _status,
    'serial_communication/McuStatus2': _status,
    'serial_communication/SerialMsg': lambda m: [FieldValue(
        'frame', f"{m.link} {'sent' if m.direction else 'received'} {m.error or m.text}")],
    'serial_communication/Ticks': lambda m: [FieldValue('ticks', m.value, 'in 10 ms', 0)],
    'serial_communication/Voltage': lambda m: [FieldValue('voltage', m.value, 'V', 2)],
}
