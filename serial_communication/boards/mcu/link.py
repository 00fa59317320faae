"""The link to the sensor board."""
import logging
from typing import Any, Callable, Optional

from ...link.link import Link
from ...link.sparing_log import SparingLog
from ...transport.pace import clock
from ...transport.port import Port
from .session import SensorSession


class McuLink(Link):
    """Receives frames, and sends settings alone: see `SensorSession`.

    Args:
        link_arguments: frame_timeout, clock, earlier and board_time, as for `Link`.
        session_arguments: those of `SensorSession`.
    """

    session: SensorSession

    def __init__(self, port: Port, timeout: float = 1.0,
                 logger: Optional[logging.Logger] = None, now: Callable[[], float] = clock,
                 frame_timeout: float = 0.05, board_time: bool = True,
                 **arguments: Any) -> None:
        log = SparingLog('mcu', logger or logging.getLogger(__name__), clock=now)
        link_arguments = {name: arguments.pop(name) for name in ('clock', 'earlier')
                          if name in arguments}
        super().__init__(port, SensorSession(log, timeout, now=now, **arguments),
                         frame_timeout, board_time=board_time, now=now, **link_arguments)
