"""What a campaign found, as rows, and the rows as a table."""
from typing import Any, Dict, List, NamedTuple, Tuple

_SHOWN = 4      # violations of a row that are printed


class Row(NamedTuple):
    """One invariant, or (`judged` false) something that is counted and explained."""

    group: str
    says: str
    tries: int
    violations: List[Tuple[float, str]] = []   # (time, what), the time of the records
    worst: str = ''
    judged: bool = True
    note: str = ''


def render(rows: List[Row]) -> str:
    """The table, then the first violations of each row, then the notes."""
    lines = [f'{"":10} {"invariant":66} {"tries":>9} {"violations":>10}  worst case']
    group = ''
    for row in rows:
        shown = row.group if row.group != group else ''
        violations = len(row.violations) if row.judged else 'counted'
        lines.append(f'{shown:10} {row.says:66} {row.tries:9} {violations:>10}  {row.worst}')
        group = row.group
    notes = [row for row in rows if row.note]
    if notes:
        lines += ['', 'Notes']
        lines += [f'  {row.group}, {row.says}: {row.note}' for row in notes]
    for row in rows:
        if row.violations:
            lines += ['', f'VIOLATED  {row.group}: {row.says}']
            lines += [f'  at {t:.3f}: {text}' for t, text in row.violations[:_SHOWN]]
            if len(row.violations) > _SHOWN:
                lines.append(f'  and {len(row.violations) - _SHOWN} more')
    return '\n'.join(lines)


def as_dict(row: Row) -> Dict[str, Any]:
    """For JSON."""
    return dict(row._asdict(), violations=[{'t': t, 'what': what} for t, what in row.violations])
