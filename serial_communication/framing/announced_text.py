"""The text of an announcement <-> rows, as a file with parameters would hold them.

A row is not checked here: `custom_messages` does that, for rows of parameters and of boards alike.
PyYAML is imported late: without announcements nobody needs it.
"""
from typing import Any, Dict, Iterator, List, NamedTuple, Tuple

from .announcement import LONGEST
from .layout import brief, readable

MOST_ROWS = 16        # in an announcement
_LONGEST_NAME = 80    # characters of the firmware's name and version


class Announcement(NamedTuple):
    """What a board announces, before its rows are checked."""

    firmware: str              # NAME VERSION; '' if it is not announced
    rows: Dict[str, Any]       # by name, as a file with parameters would hold them
    problems: List[str]        # a line for each line of the text that is no row


def read_announcement(text: bytes) -> Announcement:
    """Read the text of an announcement: one row a line, after a line with the firmware's name.

    It may hold anything: nothing is raised.
    """
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
    if problems and not rows and not _is_text(text):
        # An AVR reads the text from program memory; without PROGMEM it is in the RAM.
        problems = [f'the announcement is no text: {brief(text, 60)}: PROGMEM missing in the '
                    'sketch?']
    return Announcement(firmware, rows, problems)


def _is_text(text: bytes) -> bool:
    words = ''.join(text.decode('utf-8', 'replace').split())
    return '\N{REPLACEMENT CHARACTER}' not in readable(words)


def _read_row(line: str) -> Tuple[str, Any]:
    """The name and the row in a line; ValueError or another exception if it has none."""
    import yaml
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(line, yaml.SafeLoader)):
        raise ValueError('a reference (*) is not allowed')     # a few can mean millions of values
    found = yaml.safe_load(line)
    if not isinstance(found, dict) or len(found) != 1:
        raise ValueError('is not one row, NAME: {KEY: VALUE, …}')
    (name, row), = found.items()
    if not isinstance(name, str):
        raise ValueError('the name of the row is no text')
    if any(text != readable(text) for text in _texts(row)):
        # It could neither be published nor be set on the parameter server.
        raise ValueError('a text has a control character')
    return name, row


def _texts(value: Any) -> Iterator[str]:
    """All texts in a row, without its keys, which are checked later."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list, tuple, set)):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _texts(each)


def announcement_text(rows: Dict[str, Any], firmware: str = '') -> bytes:
    """The text that announces these rows, as `read_announcement` reads it.

    Raises:
        ValueError: it is too long, or there are too many rows.
    """
    import yaml

    class Dumper(yaml.SafeDumper):
        """Writes out what two keys share, since an announcement may have no references."""

        def ignore_aliases(self, data: Any) -> bool:
            return True

    lines = [f'firmware: {firmware}'] if firmware else []
    for name, row in rows.items():
        flow = yaml.dump({name: row}, Dumper=Dumper, default_flow_style=True, sort_keys=False,
                         width=float('inf'), allow_unicode=True)
        lines.append(flow.strip()[1:-1])       # without the braces of the group
    text = ''.join(line + '\n' for line in lines).encode()
    if len(rows) > MOST_ROWS or len(text) > LONGEST:
        raise ValueError(f'{len(rows)} rows in {len(text)} bytes cannot be announced; there may be '
                         f'{MOST_ROWS} in {LONGEST} bytes')
    return text
