"""What was kept of a line: the bytes of each read with its time (a text file), or a bag.

The text file has a line a read; `rx` is what the board sent, `tx` what was sent to it:

    # serial_communication wire recording
    # link mcu
    # baud 115200
    # began 1763769600.123456       seconds since 1970 at 0.000000
    0.000000 rx 020c109c2f003a0000000dfff3009803
    0.050134 rx 020c109d

Other lines that begin with # are remarks. A bag holds the messages of the topic `serial_msg`.
"""
from math import inf
from typing import Any, Dict, Iterable, List, NamedTuple, Optional, TextIO, Tuple

from ...framing.stream import Frame
from .lines import BAUD, MAX_BAUD, Direction, Settings

_FIRST_LINE = '# serial_communication wire recording'
_TYPE = 'serial_communication/SerialMsg'
_TX = 1                # as SerialMsg has it
_LONGEST = 1e9         # s that a recording may take …
_LATEST = 1e11         # … and since 1970 when it began: what a date can say
_DIRECTIONS = {'rx': False, 'tx': True}


class RecordingError(Exception):
    """It cannot be read; the text is for a person."""


class Read(NamedTuple):
    """The bytes that one read returned."""

    at: float      # s, of one clock
    sent: bool     # to the board; False: by the board
    data: bytes


class Seen(NamedTuple):
    """A frame, good or bad, and where it was seen. Its stamp is in seconds since the start."""

    link: str
    sent: bool
    frame: Frame
    delay: float = 0.0     # s from its stamp until it was told, beyond that of the quickest frame


class Recording(NamedTuple):
    """Either reads, from a text file, or frames, from a bag."""

    began: float                     # s since 1970, of the time 0
    reads: Dict[str, List[Read]]     # by link
    seen: List[Seen]                 # empty where there are reads
    baud: int = BAUD

    def links(self) -> List[str]:
        """Those of which there is something."""
        return sorted(set(self.reads) | {each.link for each in self.seen})


# -- text files -----------------------------------------------------------------------------


class Writer:
    """Writes such a file as bytes come.

    Args:
        began: seconds since 1970 at the time `start`.
        start: what is subtracted from the times of reads.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: str, line: Settings, began: float, start: float) -> None:
        self._start = start
        self._file: TextIO = open(path, 'w', encoding='utf-8')
        self._file.write(f'{_FIRST_LINE}\n# link {line.link}\n# baud {line.baud}\n'
                         f'# began {began:.6f}\n')
        self.flush()

    def read(self, read: Read) -> None:
        """One line."""
        self._file.write(f'{read.at - self._start:.6f} {"tx" if read.sent else "rx"} '
                         f'{read.data.hex()}\n')

    def remark(self, at: float, text: str) -> None:
        """One line that is skipped in reading."""
        self._file.write(f'# {at - self._start:.6f} {text}\n')

    def flush(self) -> None:
        """Leave what was written with the system."""
        self._file.flush()

    def close(self) -> None:
        """Write all that waits."""
        self._file.close()


def _load_text(path: str, file: TextIO) -> Recording:
    heading = {'link': '', 'baud': str(BAUD), 'began': '0'}
    reads: List[Read] = []
    latest = {False: -inf, True: -inf}
    for number, line in enumerate(file, 2):
        words = line.split()
        if line.startswith('#'):
            if len(words) >= 3 and words[1] in heading and not reads:
                heading[words[1]] = words[2]
            continue
        if not words:
            continue
        try:
            at, direction, data = words
            read = Read(_number(at, -_LONGEST, _LONGEST), _DIRECTIONS[direction],
                        bytes.fromhex(data))
        except (ValueError, KeyError):
            raise RecordingError(f'{path}:{number}: {line.strip()[:40]!r} is not SECONDS rx|tx '
                                 'HEX') from None
        if read.at < latest[read.sent]:
            raise RecordingError(f'{path}:{number}: the time goes back from '
                                 f'{latest[read.sent]:.6f} s')
        latest[read.sent] = read.at
        reads.append(read)
    reads.sort(key=lambda read: read.at)     # two threads wrote the two directions
    if not heading['link']:
        raise RecordingError(f'{path}: no line "# link"')
    try:
        return Recording(_number(heading['began'], 0, _LATEST), {heading['link']: reads}, [],
                         int(_number(heading['baud'], 1, MAX_BAUD)))
    except ValueError:
        raise RecordingError(f'{path}: "# began" or "# baud" is no number that it can be') from None


def _number(text: str, least: float, most: float) -> float:
    """ValueError where it is none, or out of range; NaN is both."""
    value = float(text)
    if not least <= value <= most:
        raise ValueError(text)
    return value


# -- bags -----------------------------------------------------------------------------------


def _load_bag(path: str, topic: str) -> Recording:
    try:
        import rosbag
    except ImportError:
        raise RecordingError(f'{path} is a bag, and to read it rosbag is missing; install it: '
                             'sudo apt-get install python3-rosbag (Noetic: ros-noetic-rosbag), '
                             'or source its setup.bash') from None
    try:
        with rosbag.Bag(path, skip_index=False) as bag:
            return _from_bag(path, bag, topic)
    except rosbag.ROSBagUnindexedException:
        raise RecordingError(f'{path} was not closed in order; mend it: rosbag reindex '
                             f'{path}') from None
    except RecordingError:
        raise
    except Exception as error:  # pylint: disable=broad-except
        # Of a damaged bag, or a type of that name with other fields, rosbag raises anything.
        words = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise RecordingError(f'{path}: not readable, damaged perhaps: {words}') from None


def _from_bag(path: str, bag: Any, topic: str) -> Recording:
    topic = _choose_topic(path, bag, topic)
    stamped = [(message, (message.header.stamp or time).to_sec(), time.to_sec())
               for _, message, time in bag.read_messages([topic])]
    if not stamped:
        raise RecordingError(f'{path}: nothing was recorded on {topic}')
    began = min(at for _, at, _ in stamped)
    quickest = min(told - at for _, at, told in stamped)
    back: Dict[Tuple[str, int], List[float]] = {}
    return Recording(began, {}, [_seen(message, at - began, back)._replace(
        delay=told - at - quickest) for message, at, told in stamped])


def _choose_topic(path: str, bag: Any, topic: str) -> str:
    found = [name for name, info in bag.get_type_and_topic_info().topics.items()
             if info.msg_type == _TYPE]
    if topic and topic not in found:
        raise RecordingError(f'{path}: {topic} is no topic of {_TYPE}; such are: '
                             f'{", ".join(found) or "none"}')
    if not topic and len(found) != 1:
        raise RecordingError(f'{path}: several topics have frames; say which with --topic: '
                             f'{", ".join(found)}' if found else
                             f'{path}: no topic of type {_TYPE}; record one with '
                             'rosbag record serial_msg')
    return topic or found[0]


def _seen(message: Any, at: float, clocks: Dict[Tuple[str, int], List[float]]) -> Seen:
    """A message as a frame. Where the clock that stamped it was set back, time goes on."""
    cause, _, error = message.error.partition(': ')
    latest, shift = clocks.setdefault((message.link, message.direction), [at, 0.0])
    at += shift
    if not cause:
        # The stamps of good frames are in order; of bad ones, behind which good ones wait, not.
        if at < latest:
            clocks[message.link, message.direction][1] += latest - at
            at = latest
        clocks[message.link, message.direction][0] = at
    return Seen(message.link, message.direction == _TX, Frame(
        bytes(message.frame), message.type, message.command, bytes(message.data), None, at,
        cause, error))


# -- both -----------------------------------------------------------------------------------


def load(path: str, topic: str = '') -> Recording:
    """Read a text file or a bag; `topic` of a bag, where it has several.

    Raises:
        RecordingError: it is neither, or damaged.
    """
    try:
        with open(path, 'rb') as file:
            first = file.readline(100)
        if first.startswith(b'#ROSBAG'):
            return _load_bag(path, topic)
        if first.strip() != _FIRST_LINE.encode():
            raise RecordingError(f'{path} is neither a bag nor what wire listen --raw writes')
        with open(path, encoding='utf-8') as text:
            text.readline()
            return _load_text(path, text)
    except UnicodeDecodeError:
        raise RecordingError(f'{path}: it is not text throughout') from None
    except OSError as error:
        raise RecordingError(f'{path}: {error.strerror}') from None


def decoded(reads: Iterable[Read], line: Settings) -> List[Seen]:
    """The frames of reads, in the order in which they were complete or given up."""
    directions = [Direction(line, sent) for sent in (False, True)]
    found: List[Seen] = []
    last: Optional[float] = None

    def take(direction: Direction, frames: Iterable[Frame]) -> None:
        found.extend(Seen(line.link, direction.sent, frame) for frame in frames)

    for read in reads:
        take(directions[read.sent], directions[read.sent].hear(read.data, read.at))
        other = directions[not read.sent]
        take(other, other.silent_until(read.at))
        last = read.at
    if last is not None:
        for direction in directions:
            take(direction, direction.silent_until(inf))
    return found
