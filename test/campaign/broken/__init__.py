"""Broken bridges: each file here is one, and the campaign has to find it.

A file has a line that says what is broken, a line with the scenario and the requirement that has to
find it, as ``exact_car.stops: SPEED 0 within ...`` (storm: 60 s of it), and changes: ``=== FILE``,
and the old (-) and the new text (+). The old text has to occur exactly once in the file of the
package.
"""
import re
from pathlib import Path
from typing import Dict, List, NamedTuple, Tuple

FOLDER = Path(__file__).parent
PACKAGE = FOLDER.parents[2] / 'serial_communication'


class Broken(NamedTuple):
    """A broken bridge."""

    name: str
    what: str
    scenario: str
    requirement: str
    changes: List[Tuple[str, str, str]]     # file, old text, new text

    def files(self) -> Dict[str, str]:
        """The changed files of the package; ValueError if a change does not apply."""
        texts: Dict[str, str] = {}
        for path, old, new in self.changes:
            file = PACKAGE / path
            text = texts.get(path) or (file.read_text() if file.exists() else '')
            if text.count(old) != 1:
                raise ValueError(f'{self.name}: occurs {text.count(old)} times in {path}: {old}')
            texts[path] = text.replace(old, new)
        return texts


def all_broken() -> List[Broken]:
    return [_read(path) for path in sorted(FOLDER.glob('*.txt'))]


def _read(path: Path) -> Broken:
    head, *changes = re.split('^=== ', path.read_text(), flags=re.MULTILINE)
    what, found_by, _empty = head.split('\n')
    scenario, requirement = found_by.split(': ', 1)
    found = []
    for change in changes:
        name, *lines = change.splitlines()
        old, new = ('\n'.join(line[1:] for line in lines if line[0] == sign) for sign in '-+')
        found.append((name, old, new))
    return Broken(path.stem, what, scenario, requirement, found)
