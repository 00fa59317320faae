"""The requirements that a campaign checks, their results, and the table of them."""
import json
import threading
import time
from typing import Any, Callable, Dict, List, Tuple

from processes import Stage, StageError

MAX_WAIT = 30.0      # s for an event without a limit of its own; only a failure takes so long
_EXAMPLES = 4        # violations of a requirement that are kept and printed


class Requirement:
    """One requirement and the results of its checks; if `counted`, only a number of events."""

    def __init__(self, group: str, text: str, counted: bool = False) -> None:
        self.group, self.text, self.counted = group, text, counted
        self.checks = 0
        self.violations = 0
        self.undecided = 0      # checks without a result
        self.examples: List[str] = []       # descriptions of the first violations
        self.violated_at = 0.0
        self.worst = float('-inf')
        self._unit = ''
        self._lock = threading.Lock()

    def check(self, holds: Any, text: str) -> bool:
        """Count one check; `text` describes the violation."""
        with self._lock:
            self.checks += 1
            if not holds:
                self.violated_at = self.violated_at or time.monotonic()
                self.violations += 1
                if len(self.examples) < _EXAMPLES:
                    self.examples.append(text[:300])
        return bool(holds)

    def at_most(self, value: float, limit: float, unit: str, text: str) -> bool:
        """Check a value against its limit, and keep the worst value."""
        self.keep_worst(value, unit)
        return self.check(value <= limit, f'{text}: {value:.4g} {unit}, limit {limit:g} {unit}')

    def keep_worst(self, value: float, unit: str) -> None:
        self.worst, self._unit = max(self.worst, value), unit

    def wait(self, condition: Callable[[], Any], text: str) -> Any:
        """Check that `condition()` becomes true within `MAX_WAIT`; StageError if it does not."""
        try:
            value = Stage.wait(condition, text, MAX_WAIT)
        except StageError as error:
            self.check(False, str(error))
            raise
        self.check(True, '')
        return value

    @property
    def worst_case(self) -> str:
        return f'{self.worst:.4g} {self._unit}' if self.worst > float('-inf') else ''


class Table:
    """All requirements, by group, in the order in which they were first used."""

    def __init__(self) -> None:
        self._requirements: Dict[Tuple[str, str], Requirement] = {}
        self._began = time.monotonic()

    def require(self, group: str, text: str, counted: bool = False) -> Requirement:
        """Return this requirement; add it if it is new."""
        return self._requirements.setdefault((group, text), Requirement(group, text, counted))

    @property
    def requirements(self) -> List[Requirement]:
        """Those that were checked, by group."""
        checked = [each for each in list(self._requirements.values())
                   if each.checks or each.undecided]
        groups = list(dict.fromkeys(each.group for each in checked))
        return sorted(checked, key=lambda each: groups.index(each.group))

    @property
    def violated(self) -> List[Requirement]:
        return [each for each in self.requirements if each.violations]

    def render(self) -> str:
        """As text: all requirements, then the first violations of each."""
        lines = [f'{"":14} {"requirement":76} {"checks":>8} {"violations":>10} '
                 f'{"not decided":>11}  worst case']
        group = ''
        for each in self.requirements:
            shown, group = (each.group if each.group != group else ''), each.group
            violations = 'counted' if each.counted else str(each.violations)
            undecided = '' if each.counted else str(each.undecided)
            lines.append(f'{shown:14} {each.text:76} {each.checks:8} {violations:>10} '
                         f'{undecided:>11}  {each.worst_case}'.rstrip())
        for each in self.violated:
            lines += ['', f'VIOLATED  {each.group}: {each.text}']
            lines += [f'  {text}' for text in each.examples]
            if each.violations > len(each.examples):
                lines.append(f'  and {each.violations - len(each.examples)} more')
        return '\n'.join(lines)

    def summary(self) -> str:
        checked = [each for each in self.requirements if not each.counted]
        return (f'{len(checked)} requirements, {len(self.violated)} violated, '
                f'{sum(each.undecided for each in checked)} checks not decided')

    def as_json(self) -> str:
        return json.dumps([{
            'group': each.group, 'requirement': each.text, 'counted': each.counted,
            'checks': each.checks, 'violations': each.violations, 'not decided': each.undecided,
            'worst case': each.worst_case, 'examples': each.examples,
            'violated after': round(each.violated_at - self._began) if each.violations else None}
            for each in self.requirements], indent=1)
