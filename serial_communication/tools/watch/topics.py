"""The bridge's topics, and their messages in numbers and in words; knows no ROS.

Numbers and words follow from a message's type, not from its topic's name, so that a topic which no
board describes is shown as well, such as one that the user has remapped. A description adds the
order, the link and the expected period.
"""
import math
import re
from typing import Any, Dict, Iterable, List, NamedTuple, Optional, Tuple, Union

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
    low: Optional[float] = None       # the least that a range sensor can measure
    high: Optional[float] = None      # the most

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


class Topic(NamedTuple):
    """A topic that the bridge publishes. `name` is relative to the node: ~imu, mcu/status, /tf."""

    name: str
    type: str                         # as ROS has it: package/Type
    links: Tuple[str, ...] = ()       # it carries data if one of these links is on; (): not known
    period: Optional[float] = None    # s from one message to the next; None: found by looking
    ages: bool = True                 # False: comes on change alone, so that no age is too old
    optional: bool = False            # only some boards send it
    fields: Tuple[str, ...] = ()      # of a custom message: paths, as its row has them

    def values(self, message: Any) -> List[Value]:
        """The message's numbers."""
        if self.fields:
            return [value for path in self.fields
                    for value in _leaves(path, _follow(message, path))]
        return list(_VALUES.get(self.type, lambda message: _leaves('', message))(message))

    def words(self, message: Any) -> str:
        """The message for a person, in one line."""
        if self.type in _WORDS and not self.fields:
            return one_line(_WORDS[self.type](message))
        values = self.values(message)
        if len(values) == 1:
            return one_line(values[0].text())
        return one_line(', '.join(f'{value.name} {value.text()}' for value in values))


def of_description(board: Description, parameters: Any = None) -> List[Topic]:
    """A board's own topics, with the periods that its parameters say."""
    own = of_board(parameters, board.name)
    return [Topic(topic.name, topic.type, (board.name,),
                  _number(own.get(topic.period_parameter)) or topic.period,
                  topic.ages, topic.optional) for topic in board.topics]


def _number(value: Any) -> Optional[float]:
    return float(value) if isinstance(value, (int, float)) else None


_AROUND = (Topic(SERIAL_MSG, 'serial_communication/SerialMsg', LINKS),
           Topic('/tf', 'tf2_msgs/TFMessage', LINKS),
           Topic('/tf_static', 'tf2_msgs/TFMessage', LINKS, ages=False),
           Topic(DIAGNOSTICS, 'diagnostic_msgs/DiagnosticArray', LINKS, 1.0))
TOPICS = (_AROUND[0], *(topic for name in BOARDS for topic in of_description(description(name))),
          *_AROUND[1:])
TABLE = {topic.name: topic for topic in TOPICS}


# -- names ---------------------------------------------------------------------------------------


def resolve(name: str, node: str) -> str:
    """A name relative to the node as an absolute one: ~imu, mcu/status, /tf."""
    if name.startswith('~'):
        return f'{node}/{name[1:]}'
    return name if name.startswith('/') else _namespace(node) + name


def relative(name: str, node: str) -> str:
    """`resolve` turned round."""
    if name.startswith(node + '/'):
        return '~' + name[len(node) + 1:]
    # One of another namespace stays absolute, and these do in any.
    inside = _namespace(node)
    if name.startswith(inside) and name not in ('/tf', '/tf_static', DIAGNOSTICS):
        return name[len(inside):]
    return name


def _namespace(node: str) -> str:
    """Where a node's relative names stand: / for /serial_communication, /car/ for /car/bridge."""
    return node.rsplit('/', 1)[0] + '/'


# -- what a bridge publishes ---------------------------------------------------------------------


def boards_of(parameters: Any) -> List[Description]:
    """Our boards, and those of other packages that the bridge's parameters name.

    One that cannot be imported here is left out: its topics and frames are shown as any others.
    """
    found = [description(name) for name in BOARDS]
    packages = parameters.get('boards') if isinstance(parameters, dict) else None
    for package in packages if isinstance(packages, list) else ():
        try:
            found.append(description(str(package)))
        except BoardError:
            pass
    return found


def known(node: str, published: Dict[str, str], parameters: Any,
          boards: Iterable[Description]) -> List[Topic]:
    """The topics of one bridge: those of the table in its order, then the others by name.

    Args:
        node: its full name, such as /serial_communication.
        published: the type of each topic that it publishes, by full name.
        parameters: its private parameters, nested as the parameter server holds them.
        boards: of these parameters: see `boards_of`.
    """
    topics = {**TABLE, **{
        topic.name: topic for board in boards
        for topic in (*of_description(board, parameters), *custom_topics(board, parameters))}}
    names = {relative(full_name, node): type_ for full_name, type_ in published.items()
             if full_name not in ('/rosout', '/clock')}
    return in_table_order(topics.get(name, Topic(name, type_))._replace(type=type_)
                          for name, type_ in names.items())


def in_table_order(topics: Iterable[Topic]) -> List[Topic]:
    """As they are always listed: those of the table in its order, then the others by name."""
    given = {topic.name: topic for topic in topics}
    return [given[name] for name in (*TABLE, *sorted(set(given) - set(TABLE))) if name in given]


def in_order(links: Iterable[str]) -> List[str]:
    """Names of links as they are always listed: those of this package first."""
    given = set(links)
    return [name for name in (*LINKS, *sorted(given - set(LINKS))) if name in given]


def expected_links(parameters: Dict[str, Any]) -> List[str]:
    """The links that have a port by the node's parameters."""
    return in_order(name for name in parameters if of_board(parameters, name).get('port'))


def custom_rows(board: Description, parameters: Any) -> Dict[str, Dict[str, Any]]:
    """The rows of a board's parameters that make custom messages or functions, by their names."""
    rows = of_board(parameters, board.name).get(board.custom.parameter) if board.custom else None
    return {name: row for name, row in (rows.items() if isinstance(rows, dict) else ())
            if isinstance(row, dict)}


def custom_topics(board: Description, parameters: Any) -> List[Topic]:
    """The topics that a board's custom messages make."""
    return [Topic(board.custom.prefix + name, str(row['ros_type']), (board.name,),
                  _number(row.get('period')), fields=_fields(row.get('reply', row)))
            for name, row in custom_rows(board, parameters).items()
            if 'ros_type' in row and row.get('direction') != 'to_board']


def _fields(row: Any) -> Tuple[str, ...]:
    paths = row.get('fields') if isinstance(row, dict) else None
    return tuple(str(path) for path in paths if path) if isinstance(paths, list) else ()


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
    words = 'rpy {roll} {pitch} {yaw} deg'.format(**values)
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


def _status_words(message: Any, measured: str) -> str:
    if not message.connected:
        return f'silent for {message.last_frame_age_sec:.1f} s'
    valid = 'valid' if message.valid else 'NOT valid'
    return f'{measured}, {valid}, {message.crc_error_count} CRC errors, seq {message.seq}'


def _channels(message: Any) -> List[Value]:
    return [Value(f'adc{channel}', getattr(message, f'adc{channel}'), '', 0)
            for channel in range(6)]


# By type; any other has the numbers of its fields.
_VALUES = {
    'sensor_msgs/Imu': _imu,
    'sensor_msgs/Range': lambda m: [Value('range', m.range, 'm', 3, m.min_range, m.max_range)],
    'sensor_msgs/RelativeHumidity': lambda m: [
        Value('humidity', m.relative_humidity * 100, '%', 2)],
    'sensor_msgs/Temperature': lambda m: [Value('temperature', m.temperature, 'degrees C', 2)],
    'serial_communication/Environment': lambda m: [
        Value('smoke', m.smoke, '', 0), Value('temperature', m.temperature, 'degrees C', 2),
        Value('humidity', m.humidity, '%', 2)],
    'serial_communication/McuStatus': _channels,
    'serial_communication/McuStatus2': lambda m: [
        Value('range 1', m.vl53_1, 'mm', 0), Value('range 2', m.vl53_2, 'mm', 0),
        Value('yaw', m.yaw, 'deg', 1), Value('pitch', m.pitch, 'deg', 1),
        Value('roll', m.roll, 'deg', 1)],
    'serial_communication/SteeringFeedback': lambda m: [Value('steering angle', m.value, '', 0)],
    'serial_communication/Ticks': lambda m: [Value('ticks', m.value, 'in 10 ms', 0)],
    'serial_communication/Voltage': lambda m: [Value('voltage', m.value, 'V', 2)],
}
# Any other has the words of its numbers.
_WORDS = {
    'sensor_msgs/Imu': _imu_words,
    'sensor_msgs/Range': _range_words,
    'serial_communication/McuStatus': lambda m: _status_words(
        m, ' '.join(value.text() for value in _channels(m))),
    'serial_communication/McuStatus2': lambda m: _status_words(
        m, f'{m.vl53_1} and {m.vl53_2} mm, '
        + ('angles unknown' if m.pitch != m.pitch else f'yaw {m.yaw:.1f} deg')),
    'serial_communication/SerialMsg': lambda m:
        f"{m.link} {'sent' if m.direction else 'received'} {m.error or m.text}",
    'serial_communication/SteeringFeedback': lambda m: f'{m.value} of 1024',
    'tf2_msgs/TFMessage': lambda m: ', '.join(
        f'{each.child_frame_id} in {each.header.frame_id}' for each in m.transforms),
    'diagnostic_msgs/DiagnosticArray': lambda m: '; '.join(
        f'{each.name}: {each.message}' for each in m.status),
}
