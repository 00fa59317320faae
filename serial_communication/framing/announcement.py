"""Announcements: a board sends the rows of its custom messages itself, as a text in chunks.

    +---------------+---------------+----------------+--------+
    | index (uint8) | count (uint8) | CRC-16 (2)     | text … |
    +---------------+---------------+----------------+--------+

`count` is the number of chunks; the chunks may have any size. The CRC is that of the whole text:
CRC-16/CCITT-FALSE, little-endian. Each link has one type for chunks, `TYPE`.
"""
import binascii
import struct
from collections import namedtuple
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

from .layout import Layout, LayoutMessage, Value, brief, readable

TYPE = 255           # message type (arduino), TYPE (mcu), CMD2 (bus)
LONGEST = 2048       # bytes of a text
MOST_ROWS = 16       # in a text
_LONGEST_NAME = 80   # characters of the firmware's name and version
_HEADER = struct.Struct('<BBH')

_Key = Tuple[int, int]     # CRC and count


def crc_of(text: bytes) -> int:
    """CRC-16/CCITT-FALSE."""
    return binascii.crc_hqx(text, 0xFFFF)


class Chunk(LayoutMessage, namedtuple('Chunk', 'index count crc text')):
    """One chunk of an announcement; its text may begin or end inside a character."""

    __slots__ = ()
    TYPE = TYPE
    LABEL = 'announcement'
    LAYOUT = Layout('<BBHs', [Value('index'), Value('count'), Value('crc'), Value('text')])

    @classmethod
    def unpack(cls, data: bytes) -> 'Chunk':
        return tuple.__new__(cls, (*_HEADER.unpack_from(data), data[_HEADER.size:]))

    def pack(self) -> bytes:
        return _HEADER.pack(*self[:3]) + self.text

    def implausible(self) -> str:
        return '' if self.index < self.count else \
            f'chunk {self.index} of {self.count}: the index has to be under the count'


class Assembly:
    """Assembles the text of one board, whatever chunks are lost, repeated, damaged or mixed up.

    Chunks belong together if they have the same CRC and count; any other chunk begins anew. Of an
    index the latest chunk counts, so a damaged one is replaced when the board sends it again.
    """

    def __init__(self) -> None:
        self.text: Optional[bytes] = None    # the latest whole text; None: none yet
        self.confirmed = False     # a chunk of it was received since the port was opened
        self._crc = -1             # of the text
        self._key: Optional[_Key] = None     # of the text; None: not assembled since then
        self.begun: Optional[_Key] = None    # of the text that is being assembled
        self._pieces: Dict[int, bytes] = {}  # its chunks' texts so far, by index

    @property
    def complete(self) -> bool:
        """Whether a whole text was assembled since the port was opened."""
        return self._key is not None

    def reset(self) -> None:
        """The board may be another one now: forget all chunks, but not the text."""
        self._key = self.begun = None
        self.confirmed = False

    def add(self, chunk: Chunk) -> Optional[bytes]:
        """Add a chunk. If it completes a text other than the latest, return that, else None."""
        key = chunk.crc, chunk.count
        self.confirmed |= chunk.crc == self._crc
        if key == self._key or chunk.implausible():
            return None     # if it differs from the text's chunk, it is damaged
        if key != self.begun:
            self.begun, self._pieces = key, {}
        self._pieces[chunk.index] = chunk.text
        text = b''.join(self._pieces[index] for index in sorted(self._pieces))
        if len(self._pieces) < chunk.count or crc_of(text) != chunk.crc:
            return None
        self._key = key
        return self.whole(text)

    def whole(self, text: bytes) -> Optional[bytes]:
        """The board announces this text; return it if it is not the latest, else None."""
        is_new = text != self.text
        self.text, self._crc, self.confirmed = text, crc_of(text), True
        return text if is_new else None


class Announcement(NamedTuple):
    """What a board announces, before its rows are checked."""

    firmware: str              # NAME VERSION; '' if it is not announced
    rows: Dict[str, Any]       # by name, as a file with parameters would hold them
    problems: List[str]        # one for each line of the text that is not a row


def read_announcement(text: bytes) -> Announcement:
    """Read the text of an announcement, which may hold anything: nothing is raised."""
    if len(text) > LONGEST:
        return Announcement('', {}, [f'the announcement has over {LONGEST} bytes; it is ignored'])
    firmware = ''
    rows: Dict[str, Any] = {}
    problems: List[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        try:
            words = line.decode().strip()
            if number == 1 and words.startswith('firmware:') and '{' not in words:
                firmware = readable(words[len('firmware:'):].strip())[:_LONGEST_NAME]
            elif words and len(rows) + len(problems) == MOST_ROWS:
                problems.append(f'there may be {MOST_ROWS} rows in an announcement: line {number} '
                                'and all after it are left out')
                break
            elif words:
                name, row = _read_row(words)
                if name in rows:
                    raise ValueError(f'there is a second row {name}')
                rows[name] = row
        except Exception as error:  # pylint: disable=broad-except
            # PyYAML raises what its constructors and the stack's limit raise.
            why = ' '.join(str(error).split())
            problems.append(readable(f'line {number} of the announcement is left out: '
                                     f'{brief(line, 60)}: {why[:120]}'))
    return Announcement(firmware, rows, problems)


def _read_row(line: str) -> Tuple[str, Any]:
    import yaml
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(line, yaml.SafeLoader)):
        raise ValueError('a reference (*) is not allowed')     # a few can mean millions of values
    found = yaml.safe_load(line)
    if not isinstance(found, dict) or len(found) != 1:
        raise ValueError('is not one row, NAME: {KEY: VALUE, …}')
    (name, row), = found.items()
    if not isinstance(name, str):
        raise ValueError('the name of the row is no text')
    return name, row
