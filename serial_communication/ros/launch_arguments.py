"""Arguments of the roslaunch above this process that roslaunch itself ignores.

roslaunch takes any NAME:=VALUE after a launch file, and ignores what the file does not declare.
After a typo such as arduino_prt:=… the bridge would open the ports of its configuration in silence.
It also ignores NAME:= without a value, before the launch file can see it.
"""
import difflib
import os
import xml.etree.ElementTree
from pathlib import Path
from typing import Iterable, List

_FILE = 'bridge.launch'
_EMPTY_PORT = '_port:='


def empty_ports() -> List[str]:
    """Return the name of each link that was turned off by an argument such as ``mcu_port:=``."""
    return [word[:-len(_EMPTY_PORT)] for word in _roslaunch() if word.endswith(_EMPTY_PORT)]


def unknown_arguments() -> List[str]:
    """Return a warning for each argument that bridge.launch does not have."""
    words = _roslaunch()
    try:
        if not words:
            return []
        import rospkg       # not at the top: most starts need it not
        launch = Path(rospkg.RosPack().get_path('serial_communication'), 'launch', _FILE)
        return warnings_of(words, xml.etree.ElementTree.parse(launch).getroot())
    except Exception:  # pylint: disable=broad-except
        return []       # no warning is worth a start that fails


def _roslaunch() -> List[str]:
    """Return the command line of the roslaunch above this process.

    Empty if that did not start bridge.launch itself: of an included file roslaunch checks them.
    """
    try:
        words = Path(f'/proc/{os.getppid()}/cmdline').read_text().split('\0')
    except (OSError, ValueError):
        return []
    return words if any(os.path.basename(word) == _FILE for word in words) else []


def warnings_of(words: Iterable[str], launch: xml.etree.ElementTree.Element) -> List[str]:
    """A warning for each NAME:=VALUE whose name is not an argument of the launch file."""
    known = [arg.get('name', '') for arg in launch.findall('arg') if 'value' not in arg.keys()]
    found = []
    for word in words:
        name, assigned, _value = word.partition(':=')
        if assigned and not name.startswith('_') and name not in known:
            near = difflib.get_close_matches(name, known, 1)
            found.append(f'{_FILE} has no argument {name}, so {word} has no effect'
                         + (f'; did you mean {near[0]}?' if near else ''))
    return found
