"""The requirements that a campaign checks, their results, and the table of them."""
import math
import time
from pathlib import Path
from typing import Any, Callable, Dict, List

_EXAMPLES = 4        # violations of a requirement that are kept and printed
_UNDECIDED = 0.05    # share of the checks that may be undecided …
_FEW = 2             # … and so many in any case


class Requirement:
    """One requirement and the results of its checks."""

    def __init__(self, table: 'Table', group: str, text: str, least: int) -> None:
        self._table, self._least = table, least
        self.group, self.text = group, text
        self.checks = self.violations = 0
        self.undecided = 0      # checks without a result, since a witness was late, too
        self.examples: List[str] = []       # descriptions of the first violations
        self._violated_at = 0.0
        self._worst, self._unit = float('-inf'), ''

    def check(self, holds: Any, text: str) -> bool:
        """Count one check; `text` describes the violation."""
        self.checks += 1
        if not holds:
            self._violated_at = self._violated_at or time.monotonic()
            self.violations += 1
            self.examples = [*self.examples, text[:300]][:_EXAMPLES]
            for on_violation in list(self._table.on_violation):
                on_violation(self.text, text)
        return bool(holds)

    def at_most(self, value: float, limit: float, unit: str, text: str) -> bool:
        """Check a value against its limit, and keep the worst value."""
        self.keep_worst(value, unit)
        return self.check(value <= limit, f'{text}: {value:.4g} {unit}, limit {limit:g} {unit}')

    def keep_worst(self, value: float, unit: str) -> None:
        self._worst, self._unit = max(self._worst, value), unit

    @property
    def worst_case(self) -> str:
        return f'{self._worst:.4g} {self._unit}' if self._worst > float('-inf') else ''

    @property
    def least(self) -> int:
        """How often it should have been checked until now."""
        return math.floor(self._least * self._table.minutes)

    @property
    def is_undecided(self) -> bool:
        return self.undecided > max(_FEW, _UNDECIDED * self.checks)

    @property
    def failure(self) -> str:
        """Why it is not fulfilled, if so."""
        if self.violations:
            return f'VIOLATED after {self._violated_at - self._table.began:.1f} s'
        return ('NOT TRIED ENOUGH' if self.checks < self.least
                else 'NOT DECIDED TOO OFTEN' if self.is_undecided else '')


class Table:
    """All requirements of rows.txt: by group, with how often each has to be checked in a minute.

    A requirement that was checked less often, or too often without a result, is not fulfilled.

    Attributes:
        on_violation: called with a requirement and what has violated it.
        minutes: for how long it ran.
    """

    def __init__(self) -> None:
        self.on_violation: List[Callable[[str, str], Any]] = []
        self.minutes = 0.0
        self._rows: Dict[str, Requirement] = {}
        self.began = time.monotonic()
        group = ''
        for line in Path(__file__).with_name('rows.txt').read_text().splitlines():
            if line.startswith(' '):
                least, text = line.split(None, 1)
                self._rows[text] = Requirement(self, group, text, int(least))
            else:
                group = line

    def row(self, text: str) -> Requirement:
        return self._rows[text]

    @property
    def used(self) -> List[Requirement]:
        """Those that were checked, or should have been."""
        return [each for each in self._rows.values() if each.checks or each.undecided or each.least]

    @property
    def failed(self) -> List[Requirement]:
        return [each for each in self.used if each.failure]

    def __str__(self) -> str:
        """All requirements, the first violations of each, and whether all was tried enough."""
        lines = [f'{"":14} {"requirement":76} {"least":>7} {"checks":>8} {"violations":>10} '
                 f'{"not decided":>11}  worst case']
        group = ''
        for each in self.used:
            shown, group = (each.group if each.group != group else ''), each.group
            lines.append(f'{shown:14} {each.text:76} {each.least:7} {each.checks:8} '
                         f'{each.violations:10} {each.undecided:11}  {each.worst_case}'.rstrip())
        for each in self.failed:
            lines += ['', f'{each.failure}  {each.group}: {each.text}']
            lines += [f'  {text}' for text in each.examples]
            if each.violations > len(each.examples):
                lines.append(f'  and {each.violations - len(each.examples)} more')
        return '\n'.join([*lines, '', self._conclusion()])

    def _conclusion(self) -> str:
        few = sum(each.checks < each.least for each in self.used)
        tried = (f'{few} not tried as often as they have to be' if few
                 else 'each tried as often as it has to be')
        violated = sum(each.violations > 0 for each in self.used)
        too_often = sum(each.is_undecided for each in self.used)
        undecided = sum(each.undecided for each in self.used)
        return (f'{len(self.used)} requirements, {tried}; {violated} violated; '
                f'{undecided} checks not decided' + (
                    f', too many of {too_often} requirements' if too_often else ''))
