"""Recordings of a line: the bytes and time of each read (a text file), or a bag.

The text file has one line for each read; `rx` is what the board sent, `tx` what was sent to it:

    # serial_communication wire recording
    # link mcu
    # baud 115200
    # began 1763769600.123456       seconds since 1970 at 0.000000
    0.000000 rx 020c109c2f003a0000000dfff3009803
    0.050134 rx 020c109d

Other lines that begin with # are comments. A bag holds the messages of the topic `serial_msg`.
"""
from math import inf
from typing import Any, Dict, List, NamedTuple, TextIO, Tuple

from ...framing.stream import UNKNOWN, Decoder, Frame
from .announced import with_announced
from .lines import MAX_BAUD, Direction, Settings
from .show import WireError

_FIRST_LINE = '# serial_communication wire recording'
_TYPE = 'serial_communication/SerialMsg'
_TX = 1                # as SerialMsg has it
_LONGEST = 1e9         # s; the longest recording
_LATEST = 1e11         # s since 1970; the latest start, within the range of dates
_DIRECTIONS = {'rx': False, 'tx': True}


class RecordingError(WireError):
    """The recording cannot be read."""


class Read(NamedTuple):
    """The bytes that one read returned."""

    at: float      # s, of one clock for all reads
    sent: bool     # to the board; False: by the board
    data: bytes


class RecordedFrame(NamedTuple):
    """A frame, valid or invalid, with its link and direction. Its stamp is in s since the start."""

    link: str
    sent: bool
    frame: Frame


class Recording(NamedTuple):
    """The reads of a text file, or the frames of a bag."""

    began: float                     # s since 1970 at the time 0
    reads: Dict[str, List[Read]]     # by link
    frames: List[RecordedFrame]      # empty where there are reads
    baud: int = 0                    # 0: not known

    def links(self) -> List[str]:
        """Return the links of the recording."""
        return sorted(set(self.reads) | {each.link for each in self.frames})


# -- text files -----------------------------------------------------------------------------


def heading(line: Settings, began: float) -> str:
    """Return the first lines of a text file; `began` is in seconds since 1970."""
    return f'{_FIRST_LINE}\n# link {line.link}\n# baud {line.baud}\n# began {began:.6f}\n'


def read_line(read: Read, start: float) -> str:
    """Return the line of a read, in a file that began at the time `start`."""
    return f'{read.at - start:.6f} {"tx" if read.sent else "rx"} {read.data.hex()}\n'


def _load_text(path: str, file: TextIO) -> Recording:
    header = {'link': '', 'baud': '', 'began': '0'}
    reads: List[Read] = []
    latest = {False: -inf, True: -inf}
    for number, line in enumerate(file, 2):
        words = line.split()
        if line.startswith('#'):
            if len(words) >= 3 and words[1] in header and not reads:
                header[words[1]] = words[2]
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
            raise RecordingError(f'{path}:{number}: the time {read.at:.6f} s goes back from '
                                 f'{latest[read.sent]:.6f} s')
        latest[read.sent] = read.at
        reads.append(read)
    reads.sort(key=lambda read: read.at)     # two threads wrote the two directions
    if not header['link']:
        raise RecordingError(f'{path}: no line "# link"')
    try:
        return Recording(_number(header['began'], 0, _LATEST), {header['link']: reads}, [],
                         int(_number(header['baud'], 1, MAX_BAUD)) if header['baud'] else 0)
    except ValueError as error:
        raise RecordingError(f'{path}: "# began" (0 … {_LATEST:g} s) or "# baud" (1 … {MAX_BAUD}) '
                             f'is out of range or not a number: {error}') from None


def _number(text: str, least: float, most: float) -> float:
    """Convert a number; ValueError if it is NaN, out of range, or not a number."""
    value = float(text)
    if not least <= value <= most:
        raise ValueError(text)
    return value


# -- bags -----------------------------------------------------------------------------------


def _load_bag(path: str, topic: str) -> Recording:
    try:
        import rosbag
    except ImportError:
        raise RecordingError(f'{path} is a bag, and rosbag, which reads bags, is missing; install: '
                             'sudo apt-get install python3-rosbag (Noetic: ros-noetic-rosbag), '
                             'or source its setup.bash') from None
    try:
        with rosbag.Bag(path, skip_index=False) as bag:
            return _from_bag(path, bag, topic)
    except rosbag.ROSBagUnindexedException:
        raise RecordingError(f'{path} was not closed properly; repair it: rosbag reindex '
                             f'{path}') from None
    except RecordingError:
        raise
    except Exception as error:  # pylint: disable=broad-except
        # rosbag raises anything for a damaged bag, or a type of that name with other fields.
        words = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise RecordingError(f'{path}: cannot be read, and may be damaged: {words}') from None


def _from_bag(path: str, bag: Any, topic: str) -> Recording:
    topic = _choose_topic(path, bag, topic)
    stamped = [(message, (message.header.stamp or time).to_sec())
               for _, message, time in bag.read_messages([topic])]
    if not stamped:
        raise RecordingError(f'{path}: {topic} has no messages')
    began = min(at for _, at in stamped)
    clocks: Dict[Tuple[str, int], List[float]] = {}
    return Recording(began, {}, [_recorded(message, at - began, clocks)
                                 for message, at in stamped])


def _choose_topic(path: str, bag: Any, topic: str) -> str:
    found = [name for name, info in bag.get_type_and_topic_info().topics.items()
             if info.msg_type == _TYPE]
    if topic and topic not in found:
        raise RecordingError(f'{path}: {topic} is not a topic of type {_TYPE}; these are: '
                             f'{", ".join(found) or "none"}')
    if not topic and len(found) != 1:
        raise RecordingError(f'{path}: several topics have frames; choose one with --topic: '
                             f'{", ".join(found)}' if found else
                             f'{path}: no topic of type {_TYPE}; record one with '
                             'rosbag record serial_msg')
    return topic or found[0]


def _recorded(message: Any, at: float, clocks: Dict[Tuple[str, int], List[float]]) -> RecordedFrame:
    """A message as a frame. If the clock of its stamp was set back, the time stays monotonic."""
    cause, _, error = message.error.partition(': ')
    latest, shift = clocks.setdefault((message.link, message.direction), [at, 0.0])
    at += shift
    if not cause:
        # Valid frames are stamped in order. Invalid ones, which delay valid ones, may not be.
        if at < latest:
            clocks[message.link, message.direction][1] += latest - at
            at = latest
        clocks[message.link, message.direction][0] = at
    return RecordedFrame(message.link, message.direction == _TX, Frame(
        bytes(message.frame), message.type, message.command, bytes(message.data), None, at,
        cause, error))


# -- both -----------------------------------------------------------------------------------


def load(path: str, topic: str = '') -> Recording:
    """Read a text file, or a bag with frames on `topic` ('': its only topic with frames).

    Raises:
        RecordingError: the file is neither, or damaged.
    """
    try:
        with open(path, 'rb') as file:
            first = file.readline(100)
        if first.startswith(b'#ROSBAG'):
            return _load_bag(path, topic)
        if first.strip() != _FIRST_LINE.encode():
            raise RecordingError(f'{path} is neither a bag nor a file of wire listen --raw')
        with open(path, encoding='utf-8') as text:
            text.readline()
            return _load_text(path, text)
    except UnicodeDecodeError:
        raise RecordingError(f'{path}: contains bytes that are not text') from None
    except OSError as error:
        raise RecordingError(f'{path}: {error.strerror}') from None


def learned_from(recording: Recording, line: Settings) -> Settings:
    """Return the line with the custom messages that its board announces in the recording."""
    frames = [(each.sent, each.frame) for each in frames_of(recording, line)]
    # A request and its reply may have the same time.
    return with_announced(line, sorted(frames, key=lambda each: (each[1].stamp, not each[0])))


def frames_of(recording: Recording, line: Settings) -> List[RecordedFrame]:
    """Return all frames of one link: those from the board, then those to the board, both in the
    order in which they were on the line."""
    found: List[RecordedFrame] = []
    for sent in (False, True):
        direction = Direction(line, sent)
        frames: List[Frame] = []
        for read in recording.reads.get(line.link, []):
            if read.sent == sent:
                frames += direction.feed(read.data, read.at)
        frames += direction.expire(inf)
        found += [RecordedFrame(line.link, sent, frame) for frame in frames]
        found += [each._replace(frame=_with_message(each.frame, direction.decoder))
                  for each in recording.frames if (each.link, each.sent) == (line.link, sent)]
    return found


def _with_message(frame: Frame, decoder: Decoder) -> Frame:
    """A frame of a bag with its message and the board's time, which a bag does not hold.

    What was unknown to the bridge may be known by now. `decoder` has had the frames before it.
    """
    again = decoder.feed(frame.raw)
    if frame.cause not in ('', UNKNOWN) or len(again) != 1:
        decoder.reset()
        return frame
    return frame._replace(message=again[0].message, cause=again[0].cause, error=again[0].error,
                          ticks=again[0].ticks)
