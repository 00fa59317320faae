"""Publishes /diagnostics: one status for each link, once a second by the monotonic clock."""
import logging
import threading
import time
from typing import Any, Callable, Iterable

import rospy
from diagnostic_updater import Updater

from ..link.link import Link
from ..link.sparing_log import SparingLog

_PERIOD = 1.0   # s


class Diagnostics:
    """The diagnostics of all links.

    Each link has an updater, since an updater has one hardware id and a link's is its port.
    """

    def __init__(self, links: Iterable[Link], logger: logging.Logger) -> None:
        self._log = SparingLog('diagnostics', logger)
        self._updaters = []
        for link in links:
            updater = Updater()
            updater.setHardwareID(link.port.url)
            updater.add(link.name + ' link', _task(link))
            self._updaters.append(updater)

    def start(self) -> None:
        """Start publishing."""
        threading.Thread(target=self._run, name='diagnostics', daemon=True).start()

    def _run(self) -> None:
        while True:
            for updater in self._updaters:
                try:
                    updater.force_update()      # update() would count in ROS time, which may stop
                except Exception as error:  # pylint: disable=broad-except
                    log_fault(self._log, error)
            time.sleep(_PERIOD)


def log_fault(log: SparingLog, error: Exception) -> None:
    """Log an unexpected error of a thread that continues, unless rospy has shut down."""
    if not rospy.is_shutdown():
        log.error('fault', f'fault in the bridge: {error!r}')


def _task(link: Link) -> Callable[[Any], Any]:
    def run(status: Any) -> Any:
        report = link.report(link.now())
        status.summary(report.level, report.summary)
        for key, value in report.values:
            status.add(key, str(value))
        return status
    return run
