"""The requirements that a campaign checks, their results, and the table of them."""
import json
import math
import time
from pathlib import Path
from typing import Any, Callable, Dict, List, Tuple

from processes import Stage, StageError

MAX_WAIT = 30.0      # s for an event without a limit of its own; only a failure takes so long
_EXAMPLES = 4        # violations of a requirement that are kept and printed
_UNDECIDED = 0.05    # share of the checks that may be undecided …
_FEW = 2             # … and so many in any case


class Requirement:
    """One requirement and the results of its checks."""

    def __init__(self, table: 'Table', part: str, group: str, text: str, least: int) -> None:
        self._table, self._part, self._least = table, part, least
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
    def results(self) -> Tuple[Any, ...]:
        """What `add` takes in another process."""
        return (self.checks, self.violations, self.undecided, self.examples, self._violated_at,
                self._worst, self._unit)

    def add(self, checks: int, violations: int, undecided: int, examples: List[str],
            violated_at: float, worst: float, unit: str) -> None:
        """Add the results of another process."""
        self.checks += checks
        self.violations += violations
        self.undecided += undecided
        self.examples = [*self.examples, *examples][:_EXAMPLES]
        self._violated_at = min(filter(None, (self._violated_at, violated_at)), default=0.0)
        self._worst, self._unit = max(self._worst, worst), self._unit or unit

    @property
    def worst_case(self) -> str:
        return f'{self._worst:.4g} {self._unit}' if self._worst > float('-inf') else ''

    @property
    def least(self) -> int:
        """How often it should have been checked until now."""
        return math.floor(self._least * self._table.runs[self._part])

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


Results = Dict[Requirement, Dict[str, Any]]


class Table:
    """All requirements of rows.txt: by group, with how often each has to be checked at least.

    That is in each run of the exact part; in the groups of the storm, in each minute of it. A
    requirement that was checked less often, or too often without a result, is not fulfilled.

    Attributes:
        on_violation: called with a requirement and what has violated it.
        part: the part that runs now, `exact` or `storm`.
        runs: how often each part was run; of the storm the minutes.
        until: the requirement whose violation ends the campaign.
    """

    def __init__(self) -> None:
        self.on_violation: List[Callable[[str, str], Any]] = []
        self.part, self.until = 'exact', ''
        self.runs: Dict[str, float] = {'exact': 0, 'storm': 0}
        self._rows: Dict[Tuple[str, str], Requirement] = {}
        self.began = time.monotonic()
        group = ''
        for line in Path(__file__).with_name('rows.txt').read_text().splitlines():
            if line.startswith(' '):
                least, text = line.split(None, 1)
                part = group.split(':')[0] if group.startswith('storm') else 'exact'
                assert (part, text) not in self._rows, text
                self._rows[part, text] = Requirement(self, part, group, text, int(least))
            else:
                group = line

    def row(self, text: str) -> Requirement:
        """The requirement of the part that runs now, or else of the exact part."""
        return self._rows.get((self.part, text)) or self._rows['exact', text]

    @property
    def rows(self) -> List[Requirement]:
        return list(self._rows.values())

    @property
    def used(self) -> List[Requirement]:
        """Those that were checked, or should have been."""
        return [each for each in self.rows if each.checks or each.undecided or each.least]

    def results(self) -> Results:
        """All results so far."""
        return {row: dict(vars(row)) for row in self.rows}

    @staticmethod
    def grown(what: str, since: Results) -> List[Requirement]:
        """The requirements with more `violations`, or more `undecided` checks, since then."""
        return [row for row, before in since.items() if vars(row)[what] > before[what]]

    @staticmethod
    def take_back(results: Results) -> None:
        """Forget all later results."""
        for row, before in results.items():
            vars(row).update(before)

    def dump(self) -> str:
        """Return all results as JSON, for `add` in another process."""
        return json.dumps([row.results for row in self.rows])

    def add(self, dumped: str) -> None:
        """Add the results of another process; an empty text has none."""
        for row, results in zip(self.rows, json.loads(dumped or '[]')):
            row.add(*results)

    @property
    def violated(self) -> List[Requirement]:
        return [each for each in self.used if each.violations]

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
                 else 'each tried as often as it has to be' if any(self.runs.values())
                 else 'only a part of the scenarios was run')
        too_often = sum(each.is_undecided for each in self.used)
        undecided = sum(each.undecided for each in self.used)
        return (f'{len(self.used)} requirements, {tried}; {len(self.violated)} violated; '
                f'{undecided} checks not decided' + (
                    f', too many of {too_often} requirements' if too_often else ''))
