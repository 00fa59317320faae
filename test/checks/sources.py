"""Lists the files of this package by kind."""
from pathlib import Path
from typing import List

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / 'serial_communication'


def _with_interpreter(*names: str) -> List[Path]:
    """Programs without a suffix whose first line names one of these interpreters."""
    found = []
    for path in sorted(path for folder in ('scripts', '.ci', 'test/bench', 'test/panel')
                       for path in (ROOT / folder).iterdir()):
        if path.is_file() and not path.suffix:
            first = path.read_text().split('\n', 1)[0]
            if first.startswith('#!') and first.split('/')[-1].split()[-1] in names:
                found.append(path)
    return found


def python_programs() -> List[Path]:
    """Return the Python programs that rosrun finds."""
    return _with_interpreter('python3')


def shell_files() -> List[Path]:
    """Return the shell scripts and the files that they source."""
    return _with_interpreter('bash', 'sh') + sorted((ROOT / 'scripts').glob('*.bash'))


def python_files() -> List[Path]:
    """Return every Python file and program."""
    return [ROOT / 'setup.py', *sorted(PACKAGE.rglob('*.py')),
            *(path for folder in ('doc', 'test') for path in sorted((ROOT / folder).rglob('*.py'))),
            *python_programs()]


def name(path: Path) -> str:
    """Return the path relative to the checkout, as the id of a test."""
    return str(path.relative_to(ROOT))
