"""What a campaign found, as rows, and the rows as a table."""
import json
import threading
import time
from typing import Any, Callable, Dict, List, Tuple

from processes import Stage, StageError

PATIENCE = 30.0      # s for what has no limit of its own; waited out only if it never comes
_SHOWN = 4      # violations of a row that are kept and printed


class Row:
    """One promise, and how often it was tried; or, `counted`, a measurement."""

    def __init__(self, group: str, promise: str, counted: bool = False) -> None:
        self.group = group
        self.promise = promise
        self.counted = counted
        self.tries = 0
        self.violations = 0
        self.undecided = 0      # tries of which nobody can tell: none in the exact part
        self.first: List[str] = []          # of the violations
        self.first_at = 0.0
        self.worst = float('-inf')
        self._unit = ''
        self._lock = threading.Lock()

    def check(self, holds: Any, text: str) -> bool:
        """One try; `text` says what happened instead."""
        with self._lock:
            self.tries += 1
            if not holds:
                self.first_at = self.first_at or time.monotonic()
                self.violations += 1
                if len(self.first) < _SHOWN:
                    self.first.append(text[:300])
        return bool(holds)

    def at_most(self, value: float, limit: float, unit: str, text: str) -> bool:
        """One try of a promise that has a limit; the worst value is kept."""
        self.note(value, unit)
        return self.check(value <= limit, f'{text}: {value:.4g} {unit}, may be {limit:g} {unit}')

    def note(self, value: float, unit: str) -> None:
        self.worst, self._unit = max(self.worst, value), unit

    def wait(self, condition: Callable[[], Any], text: str) -> Any:
        """One try: `condition()` becomes true within `PATIENCE`, or the scenario ends here."""
        try:
            value = Stage.wait(condition, text, PATIENCE)
        except StageError as error:
            self.check(False, str(error))
            raise
        self.check(True, '')
        return value

    @property
    def worst_case(self) -> str:
        return f'{self.worst:.4g} {self._unit}' if self.worst > float('-inf') else ''


class Table:
    """All rows, by group, in the order in which they were first asked for."""

    def __init__(self) -> None:
        self._rows: Dict[Tuple[str, str], Row] = {}
        self._began = time.monotonic()

    def row(self, group: str, promise: str, counted: bool = False) -> Row:
        """This one; a new one where there is none."""
        return self._rows.setdefault((group, promise), Row(group, promise, counted))

    @property
    def rows(self) -> List[Row]:
        """Those of which something is known, by group."""
        known = [row for row in list(self._rows.values()) if row.tries or row.undecided]
        groups = list(dict.fromkeys(row.group for row in known))
        return sorted(known, key=lambda row: groups.index(row.group))

    @property
    def violated(self) -> List[Row]:
        return [row for row in self.rows if row.violations]

    def render(self) -> str:
        """As text: the rows, then the first violations of each."""
        lines = [f'{"":14} {"promise":76} {"tries":>8} {"violations":>10} {"not decided":>11}  '
                 'worst case']
        group = ''
        for row in self.rows:
            shown, group = (row.group if row.group != group else ''), row.group
            violations = 'counted' if row.counted else str(row.violations)
            undecided = '' if row.counted else str(row.undecided)
            lines.append(f'{shown:14} {row.promise:76} {row.tries:8} {violations:>10} '
                         f'{undecided:>11}  {row.worst_case}'.rstrip())
        for row in self.violated:
            lines += ['', f'VIOLATED  {row.group}: {row.promise}']
            lines += [f'  {text}' for text in row.first]
            if row.violations > len(row.first):
                lines.append(f'  and {row.violations - len(row.first)} more')
        return '\n'.join(lines)

    def summary(self) -> str:
        judged = [row for row in self.rows if not row.counted]
        return (f'{len(judged)} promises, {len(self.violated)} violated, '
                f'{sum(row.undecided for row in judged)} tries not decided')

    def as_json(self) -> str:
        return json.dumps([{
            'group': row.group, 'promise': row.promise, 'counted': row.counted,
            'tries': row.tries, 'violations': row.violations, 'not decided': row.undecided,
            'worst case': row.worst_case, 'first': row.first,
            'first after': round(row.first_at - self._began) if row.first_at else None}
            for row in self.rows], indent=1)
