"""Arguments of roslaunch that bridge.launch does not have.

roslaunch takes any NAME:=VALUE after a launch file, and ignores what the file does not declare.
After a typo such as arduino_prt:=… the bridge would open the ports of its configuration in silence.
"""
import difflib
import os
import xml.etree.ElementTree
from pathlib import Path
from typing import Iterable, List

_FILE = 'bridge.launch'


def unknown_arguments() -> List[str]:
    """A warning for each argument of the roslaunch above this process that was not used.

    Empty if that did not start bridge.launch itself: of an included file roslaunch checks them.
    """
    try:
        words = Path(f'/proc/{os.getppid()}/cmdline').read_text().split('\0')
        if not any(os.path.basename(word) == _FILE for word in words):
            return []
        import rospkg       # not at the top: most starts need it not
        launch = Path(rospkg.RosPack().get_path('serial_communication'), 'launch', _FILE)
        return warnings_of(words, xml.etree.ElementTree.parse(launch).getroot())
    except Exception:  # pylint: disable=broad-except
        return []       # no warning is worth a start that fails


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
