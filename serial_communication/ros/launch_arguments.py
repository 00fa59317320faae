"""Arguments of the roslaunch above this process that never reach its launch file.

`mcu_port:=`, which turns a link off, is dropped because it has no value. After a typo such as
arduino_prt:=… the bridge would open the ports of its configuration in silence.
"""
import difflib
import os
import xml.etree.ElementTree
from pathlib import Path
from typing import List

_FILE = 'bridge.launch'
_EMPTY_PORT = '_port:='


def roslaunch_words() -> List[str]:
    """Return the command line of the roslaunch above this process.

    Empty if that did not start bridge.launch itself: of an included file roslaunch checks them.
    """
    try:
        words = Path(f'/proc/{os.getppid()}/cmdline').read_text().split('\0')
    except (OSError, ValueError):
        return []
    return words if any(os.path.basename(word) == _FILE for word in words) else []


def empty_ports(words: List[str]) -> List[str]:
    """Return the name of each link that was turned off by an argument such as ``mcu_port:=``."""
    return [word[:-len(_EMPTY_PORT)] for word in words if word.endswith(_EMPTY_PORT)]


def unknown_arguments(words: List[str]) -> List[str]:
    """Return a warning for each NAME:=VALUE whose name is no argument of bridge.launch."""
    if not words:
        return []
    try:
        import rospkg       # not at the top: most starts need it not
        path = Path(rospkg.RosPack().get_path('serial_communication'), 'launch', _FILE)
        arguments = xml.etree.ElementTree.parse(path).findall('arg')
    except Exception:  # pylint: disable=broad-except
        return []       # no warning is worth a start that fails
    known = [arg.get('name', '') for arg in arguments if 'value' not in arg.keys()]
    found = []
    for word in words:
        name, assigned, _value = word.partition(':=')
        if assigned and not name.startswith('_') and name not in known:
            near = difflib.get_close_matches(name, known, 1)
            found.append(f'{_FILE} has no argument {name}, so {word} has no effect'
                         + (f'; did you mean {near[0]}?' if near else ''))
    return found
