"""Counts the results of the test programs of scripts/test, from their XML files.

    results.py FOLDER

FOLDER has a folder for each test program, with its JUnit XML files, `log` (its output) and
`status` (its exit status). With a file `by_status`, the program itself is one test. A program
without results, or that failed although none of its tests did, counts as one failure with its
name. Prints the failures and why tests were skipped, then the line `N passed, N failed` (and
`, N skipped`), and ends with status 1 if anything failed.
"""
import sys
from pathlib import Path
from typing import List, NamedTuple, Tuple
from xml.etree import ElementTree

_LOG_LINES = 40      # of a program without results
_MESSAGE_LINES = 40  # of a failed test


class Results(NamedTuple):
    """The results of one test program, or of all."""

    passed: int
    failures: List[Tuple[str, str]]    # name of the test, and its message
    skipped: List[Tuple[str, str]]     # name of the test, and the reason

    def __str__(self) -> str:
        text = '%d passed, %d failed' % (self.passed, len(self.failures))
        return text + (', %d skipped' % len(self.skipped) if self.skipped else '')


def of_program(folder: Path) -> Results:
    """Return the results of one test program."""
    passed, failures, skipped = 0, [], []
    for path in sorted(folder.rglob('*.xml')):
        # rostest's own file lists each program that it ran as a test. A program counts by its own
        # file, and here only if it ended without one.
        wraps = path.name.startswith('rostest-')
        try:
            cases = list(ElementTree.parse(str(path)).getroot().iter('testcase'))
        except ElementTree.ParseError as error:
            failures.append((path.name, 'no XML: %s' % error))
            continue
        for case in cases:
            name = '%s.%s' % (case.get('classname', ''), case.get('name', ''))
            skip = case.find('skipped')
            failed = [child for child in case if child.tag in ('failure', 'error')]
            if failed:
                failures.append((name, '\n'.join(_message(child) for child in failed)))
            elif skip is not None:
                skipped.append((name, skip.get('message') or 'no reason given'))
            elif not wraps:
                passed += 1
    status = _read(folder / 'status').strip() or 'none'
    if status == '0' and (folder / 'by_status').exists():
        passed += 1
    if not failures and (status != '0' or not (passed or skipped)):
        failures.append((folder.name, '%s (status %s); its last output:\n%s' % (
            'failed as a whole' if passed or skipped else 'gave no result', status,
            _tail(_read(folder / 'log'), _LOG_LINES))))
    return Results(passed, failures, skipped)


def total(parts: List[Results]) -> Results:
    """Return the sum of the results."""
    return Results(sum(part.passed for part in parts),
                   [failure for part in parts for failure in part.failures],
                   [skip for part in parts for skip in part.skipped])


def _message(element: ElementTree.Element) -> str:
    """The text of a failure, which is its message in full, or the message."""
    return _tail((element.text or '').strip() or element.get('message') or '', _MESSAGE_LINES)


def _tail(text: str, count: int) -> str:
    lines = text.rstrip().splitlines()
    return '\n'.join((['...'] if len(lines) > count else []) + lines[-count:])


def _read(path: Path) -> str:
    try:
        return path.read_text(errors='replace')
    except OSError:
        return ''


def main(argv: List[str]) -> int:
    """Print the failures and the count of all programs in a folder; return the exit status."""
    folders = sorted(path for path in Path(argv[0]).iterdir() if path.is_dir())
    parts = [(folder.name, of_program(folder)) for folder in folders]
    for program, results in parts:
        for name, said in results.failures:
            print('\n--- %s: %s' % (program, name))
            print('\n'.join('    ' + line for line in said.splitlines()))
    for program, results in parts:
        for name, reason in results.skipped:
            print('skipped: %s: %s: %s' % (program, name, reason))
    result = total([results for _, results in parts])
    print('\n' + str(result))
    return 1 if result.failures or not parts else 0


if __name__ == '__main__':
    if hasattr(sys.stdout, 'reconfigure'):
        sys.stdout.reconfigure(errors='replace')
    sys.exit(main(sys.argv[1:]))
