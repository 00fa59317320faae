"""The state of a link, for /diagnostics."""
from typing import Any, List, NamedTuple, Tuple

from ..framing.stream import CHECKSUM, FRAMING
from ..transport.port import Port
from .lending import Lending
from .receiver import Receiver
from .reopening import Reopening
from .session import ERROR, OK, WARN, Condition, Session
from .traffic import Traffic


class Report(NamedTuple):
    """What /diagnostics shows of a link."""

    level: int
    summary: str
    values: List[Tuple[str, Any]]


class Reporter:
    """Reports once a second: the errors since the report before are those of that second."""

    def __init__(self, port: Port, session: Session, traffic: Traffic, lending: Lending,
                 reopening: Reopening, receiver: Receiver) -> None:
        self._port, self._session, self._traffic = port, session, traffic
        self._lending, self._reopening, self._receiver = lending, reopening, receiver
        self._reported_errors = 0

    def report(self, now: float) -> Report:
        session, traffic, port = self._session, self._traffic, self._port
        level, name, summary = self._condition(now)
        errors = sum(traffic.errors.values()) + session.error_count()
        new, self._reported_errors = errors - self._reported_errors, errors
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
            ('reconnects', max(self._reopening.count - 1, 0)),
            ('last frame age [s]', 'never' if frame_at is None else f'{now - frame_at:.3f}'),
            *sorted((cause + ' errors', count) for cause, count in counted.items()),
            *session.values(),
            *self._receiver.stamps.values(),
        ]
        if announcement.rows is not None:
            values += [('firmware', announcement.firmware),
                       ('announced', ', '.join(announcement.rows)),
                       ('held back', announcement.held_back)]
        return Report(level, summary, values)

    def _condition(self, now: float) -> Condition:
        if self._lending.runs:
            return Condition(WARN, 'lent', str(self._lending.loan))
        if not self._port.is_open:
            return Condition(ERROR, 'closed', f'closed: {self._reopening.trouble}')
        return self._session.condition(now)
