"""A configuration with the ports that were found, for config:=.

It is the text of another configuration, comments included, in which only ports and baud rates
change. So the result documents itself, as config/bridge.yaml does.
"""
import itertools
import os
import re
from typing import Any, Dict, List, Mapping, NamedTuple

from ...boards.config_file import board_parameters, read_parameters

_CHECKOUT = os.path.join(os.path.dirname(__file__), *[os.pardir] * 3, 'config', 'bridge.yaml')


class Connection(NamedTuple):
    """Where a board is."""

    port: str
    baud: int


class WriteError(Exception):
    """The configuration cannot be written; the text is one line."""


def default_path() -> str:
    """The path of config/bridge.yaml.

    Raises:
        WriteError: it is not there.
    """
    if os.path.exists(_CHECKOUT):
        return os.path.normpath(_CHECKOUT)
    try:
        import rospkg
        return os.path.join(rospkg.RosPack().get_path('serial_communication'), 'config',
                            'bridge.yaml')
    except (ImportError, LookupError, OSError):     # rospkg's errors are LookupErrors or OSErrors
        raise WriteError('config/bridge.yaml is not found: source the workspace') from None


def write(path: str, base: str, names: List[str], found: Mapping[str, Connection]) -> str:
    """Write a configuration, and return the path of what was there before, or ''.

    Args:
        path: the file to write. One that exists is kept beside it as FILE~, or as FILE~1, FILE~2 …
            if that exists, too.
        base: the configuration to change.
        names: all boards; the link of one that was not found is turned off.
        found: the boards' ports.

    Raises:
        WriteError: it cannot be written.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise WriteError(f'{path} is not written: it is not a regular file')
    wanted = {name: found.get(name, Connection('', 0)) for name in names}
    try:
        with open(base, encoding='utf-8') as file:
            text = file.read()
        expected = _changed(read_parameters(base), wanted)
        for name, connection in wanted.items():
            text = _with_value(text, name, 'port', connection.port or '""')
            if connection.baud:
                text = _with_value(text, name, 'baud', str(connection.baud))
        return _replace(path, base, text, expected)
    except OSError as error:
        raise WriteError(f'{error.filename or path}: {error.strerror}') from None
    except ValueError as error:
        raise WriteError(f'{base}: {error}') from None


def _replace(path: str, base: str, text: str, expected: Dict[str, Any]) -> str:
    new, before = path + '.new', ''
    with open(new, 'x', encoding='utf-8') as file:      # of nobody else
        file.write(text)
    try:
        if read_parameters(new) != expected:
            raise ValueError('its ports cannot be changed by a program; change them by hand')
        if os.path.exists(path) and os.path.getsize(path):
            before = _free_name(path + '~')
            os.replace(path, before)
        os.replace(new, path)
    finally:
        if os.path.exists(new):
            os.remove(new)
    return before


def _free_name(name: str) -> str:
    """Return the name, or with the first number after it that makes it new."""
    names = (f'{name}{number or ""}' for number in itertools.count())
    return next(each for each in names if not os.path.lexists(each))


def _changed(parameters: Dict[str, Any], wanted: Mapping[str, Connection]) -> Dict[str, Any]:
    """The parameters as they should be, to check the changed text."""
    changed = dict(parameters)
    for name, connection in wanted.items():
        changed[name] = {**board_parameters(parameters, name), 'port': connection.port}
        if connection.baud:
            changed[name]['baud'] = connection.baud
    return changed


def _with_value(text: str, name: str, key: str, value: str) -> str:
    """The text with another value of a board's key; the board and its key are added if absent."""
    group = re.search(rf'^{re.escape(name)}:[ \t]*(#.*)?\n((?:[ \t].*\n|[ \t]*\n|#.*\n)*)', text,
                      re.M)
    if not group and re.search(rf'^["\']?{re.escape(name)}["\']?[ \t]*:', text, re.M):
        raise ValueError(f'{name} is not written as a block; change its port by hand')
    if not group:
        return text.rstrip('\n') + f'\n\n{name}:\n  {key}: {value}\n'
    inside = group.group(2)
    line = re.compile(rf'^([ \t]+){key}:[ \t]*("[^"]*"|\'[^\']*\'|[^#\n]*?)([ \t]*(?:#.*)?)$', re.M)
    changed, number = line.subn(lambda found: f'{found.group(1)}{key}: {value}{found.group(3)}',
                                inside, count=1)
    if not number:
        changed = f'  {key}: {value}\n' + inside
    return text[:group.start(2)] + changed + text[group.end(2):]
