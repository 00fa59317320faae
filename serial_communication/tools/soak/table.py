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
    lines = ['%-10s %-66s %9s %10s  %s' % ('', 'invariant', 'tries', 'violations', 'worst case')]
    group = ''
    for row in rows:
        lines.append('%-10s %-66s %9d %10s  %s' % (
            row.group if row.group != group else '', row.says, row.tries,
            len(row.violations) if row.judged else 'counted', row.worst))
        group = row.group
    notes = [row for row in rows if row.note]
    if notes:
        lines += ['', 'Notes']
        lines += ['  %s, %s: %s' % (row.group, row.says, row.note) for row in notes]
    for row in rows:
        if row.violations:
            lines += ['', 'VIOLATED  %s: %s' % (row.group, row.says)]
            lines += ['  at %.3f: %s' % pair for pair in row.violations[:_SHOWN]]
            if len(row.violations) > _SHOWN:
                lines.append('  and %d more' % (len(row.violations) - _SHOWN))
    return '\n'.join(lines)


def as_dict(row: Row) -> Dict[str, Any]:
    """For JSON."""
    return dict(row._asdict(), violations=[{'t': t, 'what': what} for t, what in row.violations])
