"""The state of a link, for /diagnostics."""
from typing import TYPE_CHECKING, Any, List, NamedTuple, Tuple

from ..framing.stream import CHECKSUM, FRAMING
from .session import ERROR, OK, WARN, Condition

if TYPE_CHECKING:
    from .link import Link


class Report(NamedTuple):
    """What /diagnostics shows of a link."""

    level: int
    summary: str
    values: List[Tuple[str, Any]]


def report(link: 'Link', now: float) -> Report:
    """The errors since the report before are those of the last second."""
    session, traffic, port = link.session, link.traffic, link.port
    level, name, summary = _condition(link, now)
    errors = sum(traffic.errors.values()) + session.error_count()
    new, traffic.reported_errors = errors - traffic.reported_errors, errors
    if level == OK and new:
        level, summary = WARN, f'{new} error{"s" if new > 1 else ""} in the last second'
    if session.is_stopped:
        level, name, summary = max(level, WARN), 'stopped', f'stopped by ~stop; {summary}'
    counted = dict(traffic.errors)
    frame_at, announcement = session.presence.frame_at, session.announcement
    values = [
        ('port', port.url),
        ('state', summary),
        ('condition', name),
        ('frames received', traffic.frames_received),
        ('frames sent', traffic.frames_sent),
        ('bytes received', port.bytes_received),
        ('bytes sent', port.bytes_sent),
        ('stale', traffic.stale),
        ('checksum errors', counted.pop(CHECKSUM, 0)),
        ('framing errors', counted.pop(FRAMING, 0)),
        ('reconnects', max(link.reopening.count - 1, 0)),
        ('last frame age [s]', 'never' if frame_at is None else f'{now - frame_at:.3f}'),
        *sorted((cause + ' errors', count) for cause, count in counted.items()),
        *session.values(),
        *link.receiver.stamps.values(),
    ]
    if announcement.rows is not None:
        values += [('firmware', announcement.firmware),
                   ('announced', ', '.join(announcement.rows)),
                   ('held back', announcement.held_back)]
    return Report(level, summary, values)


def _condition(link: 'Link', now: float) -> Condition:
    if link.lending.runs:
        return Condition(WARN, 'lent', f'lent to {link.lending.by}')
    if not link.port.is_open:
        return Condition(ERROR, 'closed', f'closed: {link.reopening.trouble}')
    return link.session.condition(now)
