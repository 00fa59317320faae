"""The bridge's topics, and their messages in numbers and in words; knows no ROS.

Numbers and words follow from a message's type (`_KINDS`), not from its topic's name, so that a
topic which is not in the table below is shown as well: one of a board from another package, one
that the user has remapped. What the table adds is the order, the link and the expected period.
"""
import math
import re
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Tuple, Union

from ...boards import BOARDS, BoardError, description
from ...boards.config_file import of_board
from ...boards.description import Description

NODE = '/serial_communication'           # the bridge's name where nothing else is said
LINKS = BOARDS                           # in this order, before those of other packages
DIAGNOSTICS = '/diagnostics'
SERIAL_MSG = 'serial_msg'

_MOST_ITEMS = 16     # of an array that are looked at


class Value(NamedTuple):
    """One number (or text) of a message."""

    name: str
    value: Union[float, bool, str]
    unit: str = ''
    digits: Optional[int] = None      # behind the point; None: as many as the number has
    low: Optional[float] = None       # the least that it may be, where that is known
    high: Optional[float] = None

    def text(self) -> str:
        """The value with its unit."""
        if isinstance(self.value, bool):
            return 'yes' if self.value else 'no'
        if isinstance(self.value, str):
            return self.value
        if self.digits is not None:
            number = f'{self.value:.{self.digits}f}'
        else:
            number = str(self.value) if isinstance(self.value, int) else f'{self.value:.6g}'
        return f'{number} {self.unit}' if self.unit else number


class Field(NamedTuple):
    """A field of an own message: its path, as the configuration has it, and its limits."""

    path: str
    low: Optional[float] = None
    high: Optional[float] = None


class Topic(NamedTuple):
    """A topic that the bridge publishes. `name` is relative to the node: ~imu, mcu/status, /tf."""

    name: str
    type: str                         # as ROS has it: package/Type
    links: Tuple[str, ...] = ()       # it carries data if one of these links is on; (): not known
    period: Optional[float] = None    # s from one message to the next; None: found by looking
    ages: bool = True                 # False: comes on change alone, so that no age is too old
    optional: bool = False            # only some boards send it
    fields: Tuple[Field, ...] = ()    # of an own message

    def values(self, message: Any) -> List[Value]:
        """The message's numbers."""
        if self.fields:
            return [value._replace(low=field.low, high=field.high) for field in self.fields
                    for value in _leaves(field.path, _follow(message, field.path))]
        kind = _KINDS.get(self.type)
        return kind.values(message) if kind and kind.values else list(_leaves('', message))

    def words(self, message: Any) -> str:
        """The message for a person, in one line."""
        kind = None if self.fields else _KINDS.get(self.type)
        if kind and kind.words:
            return kind.words(message)
        values = self.values(message)
        if len(values) == 1:
            return one_line(values[0].text())
        return one_line(', '.join(f'{value.name} {value.text()}' for value in values))


def of_description(board: Description, parameters: Any = None) -> List[Topic]:
    """A board's own topics, with the periods that its parameters say."""
    found = []
    for topic in board.topics:
        period = of_board(parameters, board.name).get(topic.period_parameter)
        is_period = isinstance(period, (int, float)) and period > 0
        found.append(Topic(topic.name, topic.type, (board.name,),
                           float(period) if is_period else topic.period, topic.ages,
                           topic.optional))
    return found


_AROUND = (Topic(SERIAL_MSG, 'serial_communication/SerialMsg', LINKS),
           Topic('/tf', 'tf2_msgs/TFMessage', LINKS),
           Topic('/tf_static', 'tf2_msgs/TFMessage', LINKS, ages=False),
           Topic(DIAGNOSTICS, 'diagnostic_msgs/DiagnosticArray', LINKS, 1.0))
TOPICS = (_AROUND[0], *(topic for name in BOARDS for topic in of_description(description(name))),
          *_AROUND[1:])
_TABLE = {topic.name: topic for topic in TOPICS}


# -- names ---------------------------------------------------------------------------------------


def namespace(node: str) -> str:
    """Where a node's relative names stand: / for /serial_communication, /car/ for /car/bridge."""
    return node.rsplit('/', 1)[0] + '/'


def resolve(name: str, node: str) -> str:
    """A name relative to the node as an absolute one: ~imu, mcu/status, /tf."""
    if name.startswith('~'):
        return f'{node}/{name[1:]}'
    return name if name.startswith('/') else namespace(node) + name


def relative(name: str, node: str) -> str:
    """`resolve` turned round."""
    if name.startswith(node + '/'):
        return '~' + name[len(node) + 1:]
    # One that another namespace holds stays absolute, /tf and /diagnostics as they are written.
    inside = namespace(node)
    if inside != '/' and name.startswith(inside):
        return name[len(inside):]
    if inside == '/' and name not in ('/tf', '/tf_static', DIAGNOSTICS):
        return name[1:]
    return name


# -- what a bridge publishes ---------------------------------------------------------------------


def known(node: str, published: Dict[str, str], parameters: Dict[str, Any]) -> List[Topic]:
    """The topics of one bridge: those of the table in its order, then the others by name.

    Args:
        node: its full name, such as /serial_communication.
        published: the type of each topic that it publishes, by full name.
        parameters: its private parameters, nested as the parameter server holds them.
    """
    boards = [topic for board in boards_of(parameters)
              for topic in (*of_description(board, parameters), *custom_topics(board, parameters))]
    topics = {**_TABLE, **{topic.name: topic for topic in boards}}
    found = []
    for full_name, type_ in published.items():
        if full_name in ('/rosout', '/clock'):
            continue
        name = relative(full_name, node)
        found.append(topics.get(name, Topic(name, type_))._replace(type=type_))
    return in_table_order(found)


def in_table_order(topics: Iterable[Topic]) -> List[Topic]:
    """As they are always listed: those of the table in its order, then the others by name."""
    given = {topic.name: topic for topic in topics}
    return [given[name] for name in _TABLE if name in given] \
        + [given[name] for name in sorted(set(given) - set(_TABLE))]


def expected_links(parameters: Dict[str, Any]) -> List[str]:
    """The links that have a port by the node's parameters, those of this package first."""
    groups = [name for name, group in parameters.items()
              if isinstance(group, dict) and group.get('port')]
    return in_order(groups)


def in_order(links: Iterable[str]) -> List[str]:
    """Names of links as they are always listed."""
    given = set(links)
    return [name for name in LINKS if name in given] + sorted(given - set(LINKS))


def boards_of(parameters: Any) -> List[Description]:
    """Ours, and those of other packages that the parameters name, where they can be imported."""
    found = [description(name) for name in BOARDS]
    packages = parameters.get('boards') if isinstance(parameters, dict) else None
    for package in packages if isinstance(packages, list) else ():
        try:
            found.append(description(str(package)))
        except BoardError:
            pass        # it is not installed here, or has no description: shown as what it is
    return found


def custom_topics(board: Description, parameters: Any) -> List[Topic]:
    """The topics that a board's custom messages make."""
    custom = board.custom
    rows = of_board(parameters, board.name).get(custom.parameter) if custom else None
    found = []
    for name, row in (rows.items() if isinstance(rows, dict) else ()):
        if not isinstance(row, dict) or 'ros_type' not in row \
                or row.get('direction') == 'to_board':
            continue
        period = row.get('period')
        found.append(Topic(
            custom.prefix + name, str(row['ros_type']), (board.name,),
            float(period) if isinstance(period, (int, float)) else None,
            fields=_fields(row.get('reply', row))))
    return found


def _fields(row: Any) -> Tuple[Field, ...]:
    paths = row.get('fields', ()) if isinstance(row, dict) else ()
    paths = [paths] if isinstance(paths, str) else paths
    limits = [_each(row.get(key), len(paths)) for key in ('minimum', 'maximum')] if paths else ()
    return tuple(Field(str(path), *bounds) for path, *bounds in zip(paths, *limits) if path)


def _each(limit: Any, count: int) -> List[Optional[float]]:
    """One number for all values, or a list with one a value, as a list."""
    if not isinstance(limit, list):
        limit = [limit] * count
    return [float(each) if isinstance(each, (int, float)) else None for each in limit]


# -- any message ---------------------------------------------------------------------------------


def _follow(message: Any, path: str) -> Any:
    """What a path such as vector.x or position[2] leads to; None where it leads nowhere."""
    for name, index in re.findall(r'(\w+)(?:\[(\d+)\])?', path):
        message = getattr(message, name, None)
        if index:
            message = message[int(index)] if message and int(index) < len(message) else None
    return message


def _leaves(name: str, part: Any) -> Iterable[Value]:
    """Every number, flag and text of a message or a part of one; headers left out."""
    if isinstance(part, (bool, int, float, str)):
        yield Value(name, part)
    elif hasattr(part, 'to_sec'):
        yield Value(name, part.to_sec(), 's', 3)
    elif isinstance(part, (list, tuple, bytes)):
        for index, item in enumerate(part[:_MOST_ITEMS]):
            yield from _leaves(f'{name}[{index}]', item)
    else:
        for slot in getattr(part, '__slots__', ()):
            if slot != 'header':
                yield from _leaves(f'{name}.{slot}' if name else slot, getattr(part, slot))


def one_line(text: str) -> str:
    """A board's text as one line that a terminal takes as text."""
    return ''.join(each if each.isprintable() else ' ' for each in text)


# -- the types that the bridge itself uses -------------------------------------------------------


def _imu(message: Any) -> List[Value]:
    q = message.orientation
    angles = (math.atan2(2 * (q.w * q.x + q.y * q.z), 1 - 2 * (q.x * q.x + q.y * q.y)),
              math.asin(max(-1.0, min(1.0, 2 * (q.w * q.y - q.z * q.x)))),
              math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)))
    found = [Value(name, math.degrees(angle), 'deg', 1)
             for name, angle in zip(('roll', 'pitch', 'yaw'), angles)]
    for vector, covariance, name, unit, digits in (
            (message.angular_velocity, message.angular_velocity_covariance,
             'rate', 'rad/s', 3),
            (message.linear_acceleration, message.linear_acceleration_covariance,
             'acceleration', 'm/s^2', 2)):
        if covariance[0] != -1:      # -1: not measured
            found += [Value(f'{name} {axis}', getattr(vector, axis), unit, digits)
                      for axis in 'xyz']
    return found


def _imu_words(message: Any) -> str:
    values = {value.name: f'{value.value:.{value.digits}f}' for value in _imu(message)}
    words = f"rpy {values['roll']} {values['pitch']} {values['yaw']} deg"
    if 'acceleration x' in values:
        words += ', {} {} {} m/s^2'.format(*(values[f'acceleration {axis}'] for axis in 'xyz'))
    return words


def _range_words(message: Any) -> str:
    if math.isnan(message.range):
        return 'no reading'
    if math.isinf(message.range):
        return f'nearer than {message.min_range:.2f} m' if message.range < 0 \
            else f'farther than {message.max_range:.2f} m'
    return f'{message.range:.3f} m'


def _environment(message: Any) -> List[Value]:
    return [Value('smoke', message.smoke, '', 0),
            Value('temperature', message.temperature, 'degrees C', 2),
            Value('humidity', message.humidity, '%', 2)]


def _sensor_status(message: Any) -> List[Value]:
    return [Value('range 1', message.vl53_1, 'mm', 0), Value('range 2', message.vl53_2, 'mm', 0),
            Value('yaw', message.yaw, 'deg', 1), Value('pitch', message.pitch, 'deg', 1),
            Value('roll', message.roll, 'deg', 1)]


def _sensor_words(message: Any) -> str:
    if not message.connected:
        return _health(message)
    return f'{message.vl53_1} and {message.vl53_2} mm, yaw {message.yaw:.1f} deg, ' \
        + _health(message)


def _channels(message: Any) -> List[Value]:
    return [Value(f'adc{channel}', getattr(message, f'adc{channel}'), '', 0)
            for channel in range(6)]


def _health(message: Any) -> str:
    if not message.connected:
        return f'silent for {message.last_frame_age_sec:.1f} s'
    valid = 'valid' if message.valid else 'NOT valid'
    return f'{valid}, {message.crc_error_count} CRC errors, seq {message.seq}'


def _channel_words(message: Any) -> str:
    return ' '.join([_health(message) + ','] + [value.text() for value in _channels(message)])


def _traffic_words(message: Any) -> str:
    direction = 'sent' if message.direction else 'received'
    return one_line(f'{message.link} {direction} {message.error or message.text}')


def _frame_words(message: Any) -> str:
    return ', '.join(f'{each.child_frame_id} in {each.header.frame_id}'
                     for each in message.transforms)


def _diagnostic_words(message: Any) -> str:
    return one_line('; '.join(f'{each.name}: {each.message}' for each in message.status))


def _nothing(_message: Any) -> List[Value]:
    return []


class _Kind(NamedTuple):
    """A message type: its numbers, and its words where these do not simply list the numbers."""

    values: Optional[Callable[[Any], List[Value]]] = None
    words: Optional[Callable[[Any], str]] = None


_KINDS: Dict[str, _Kind] = {
    'sensor_msgs/Imu': _Kind(_imu, _imu_words),
    'sensor_msgs/Range': _Kind(
        lambda m: [Value('range', m.range, 'm', 3, m.min_range, m.max_range)], _range_words),
    'sensor_msgs/RelativeHumidity': _Kind(
        lambda m: [Value('humidity', m.relative_humidity * 100, '%', 2, 0, 100)]),
    'sensor_msgs/Temperature': _Kind(
        lambda m: [Value('temperature', m.temperature, 'degrees C', 2)]),
    'serial_communication/Environment': _Kind(_environment),
    'serial_communication/McuStatus': _Kind(_channels, _channel_words),
    'serial_communication/McuStatus2': _Kind(_sensor_status, _sensor_words),
    'serial_communication/SerialMsg': _Kind(_nothing, _traffic_words),
    'serial_communication/SteeringFeedback': _Kind(
        lambda m: [Value('steering angle', m.value, '', 0, 0, 1024)],
        lambda m: f'{m.value} of 1024'),
    'serial_communication/Ticks': _Kind(
        lambda m: [Value('ticks', m.value, 'in 10 ms', 0)]),
    'serial_communication/Voltage': _Kind(lambda m: [Value('voltage', m.value, 'V', 2)]),
    'tf2_msgs/TFMessage': _Kind(_nothing, _frame_words),
    'diagnostic_msgs/DiagnosticArray': _Kind(_nothing, _diagnostic_words),
}
