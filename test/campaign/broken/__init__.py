"""Broken bridges: each file here is one, and the campaign has to find it.

A file has a line that says what is broken, a line with the part of the campaign that has to find it
(as for ``soak --part``; storm: 60 s of it), and changes: ``=== FILE``, and the old (-) and the new
text (+). The old text has to occur exactly once in the file of the package.
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
    part: str
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
    what, part, *changes = re.split('^=== |\n', path.read_text(), 2)
    found = []
    for change in re.split('^=== ', changes[0], flags=re.MULTILINE)[1:]:
        name, *lines = change.splitlines()
        old, new = ('\n'.join(line[1:] for line in lines if line[0] == sign) for sign in '-+')
        found.append((name, old, new))
    return Broken(path.stem, what, part, found)
