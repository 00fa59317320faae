"""The requirements that a campaign checks, their results, and the table of them."""
import json
import math
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any, Callable, Dict, List

from processes import Stage, StageError

MAX_WAIT = 30.0      # s for an event without a limit of its own; only a failure takes so long
_EXAMPLES = 4        # violations of a requirement that are kept and printed


class Requirement:
    """One requirement and the results of its checks."""

    def __init__(self, table: 'Table', part: str, group: str, text: str, least: int) -> None:
        self._table = table
        self.part, self.group, self.text, self.least = part, group, text, least
        self.checks = self.violations = 0
        self.undecided = 0      # checks without a result, since the witness was late, too
        self.examples: List[str] = []       # descriptions of the first violations
        self.violated_at = 0.0
        self.worst, self._unit = float('-inf'), ''
        self._lock = threading.Lock()

    def check(self, holds: Any, text: str) -> bool:
        """Count one check; `text` describes the violation."""
        with self._lock:
            self.checks += 1
            if not holds:
                self.violated_at = self.violated_at or time.monotonic()
                self.violations += 1
                self.examples += [text[:300]] if len(self.examples) < _EXAMPLES else []
        if not holds:
            self._table.on_violation(self.text, text)
        return bool(holds)

    def at_most(self, value: float, limit: float, unit: str, text: str) -> bool:
        """Check a value against its limit, and keep the worst value."""
        self.keep_worst(value, unit)
        return self.check(value <= limit, f'{text}: {value:.4g} {unit}, limit {limit:g} {unit}')

    def keep_worst(self, value: float, unit: str) -> None:
        self.worst, self._unit = max(self.worst, value), unit

    def wait(self, condition: Callable[[], Any], text: str, seconds: float = MAX_WAIT) -> Any:
        """Check that `condition()` becomes true within `seconds`; StageError if it does not."""
        try:
            value = Stage.wait(condition, text, seconds)
        except StageError as error:
            self.check(False, str(error))
            raise
        self.check(True, '')
        return value

    @property
    def worst_case(self) -> str:
        return f'{self.worst:.4g} {self._unit}' if self.worst > float('-inf') else ''


class Table:
    """All requirements of rows.txt: by group, with how often each has to be checked at least.

    That is in each run of the exact part; in the groups of the storm, in each minute of it. A
    requirement that was checked less often is not fulfilled, whatever the reason is.
    """

    def __init__(self) -> None:
        self.on_violation: Callable[[str, str], None] = lambda requirement, text: None
        self.rows: Dict[str, Requirement] = {}
        group = ''
        for line in Path(__file__).with_name('rows.txt').read_text().splitlines():
            if line.startswith(' '):
                least, text = line.split(None, 1)
                part = 'storm' if group.startswith('storm') else 'exact'
                assert text not in self.rows, text
                self.rows[text] = Requirement(self, part, group, text, int(least))
            else:
                group = line
        self._runs: 'Counter[str]' = Counter()
        self._began = time.monotonic()

    def row(self, text: str) -> Requirement:
        return self.rows[text]

    def has_run(self, part: str, times: float = 1.0) -> None:
        """The whole part was begun once more; the storm: for so many minutes."""
        self._runs[part] += times       # type: ignore[assignment]

    def least(self, row: Requirement) -> int:
        """How often it should have been checked until now."""
        return math.floor(row.least * self._runs[row.part])

    @property
    def used(self) -> List[Requirement]:
        """Those that were checked, or should have been."""
        return [each for each in self.rows.values()
                if each.checks or each.undecided or self.least(each)]

    @property
    def violated(self) -> List[Requirement]:
        return [each for each in self.rows.values() if each.violations]

    @property
    def too_few(self) -> List[Requirement]:
        return [each for each in self.used if each.checks < self.least(each)]

    @property
    def is_green(self) -> bool:
        return not self.violated and not self.too_few

    def __str__(self) -> str:
        """All requirements, the first violations of each, and whether all was tried enough."""
        lines = [f'{"":14} {"requirement":76} {"least":>7} {"checks":>8} {"violations":>10} '
                 f'{"not decided":>11}  worst case']
        group = ''
        for each in self.used:
            shown, group = (each.group if each.group != group else ''), each.group
            lines.append(f'{shown:14} {each.text:76} {self.least(each):7} {each.checks:8} '
                         f'{each.violations:10} {each.undecided:11}  {each.worst_case}'.rstrip())
        for each in self.violated:
            lines += ['', f'VIOLATED  {each.group}: {each.text}']
            lines += [f'  {text}' for text in each.examples]
            if each.violations > len(each.examples):
                lines.append(f'  and {each.violations - len(each.examples)} more')
        lines += [f'\nNOT TRIED ENOUGH  {each.group}: {each.text}: '
                  f'{each.checks} of {self.least(each)}' for each in self.too_few]
        tried = (f'{len(self.too_few)} not tried as often as they have to be' if self.too_few
                 else 'each tried as often as it has to be' if self._runs else
                 'only a part of the scenarios was run')
        return '\n'.join([*lines, f'{len(self.used)} requirements, {tried}; {len(self.violated)} '
                          f'violated, {sum(each.undecided for each in self.used)} checks not '
                          'decided'])

    def as_json(self) -> str:
        return json.dumps([{
            'group': each.group, 'requirement': each.text, 'least': self.least(each),
            'checks': each.checks, 'violations': each.violations, 'not decided': each.undecided,
            'worst case': each.worst_case, 'examples': each.examples,
            'violated after': round(each.violated_at - self._began, 1) if each.violations else None}
            for each in self.used], indent=1)
