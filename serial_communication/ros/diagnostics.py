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


def log_fault(log: SparingLog, error: Exception) -> None:
    """Log an unexpected error of a thread that continues, unless rospy has shut down."""
    if not rospy.is_shutdown():
        log.error('fault', f'fault in the bridge: {error!r}')


def repeat(name: str, function: Callable[[], None], logger: logging.Logger) -> None:
    """Call a function again and again in a thread of this name; what it raises is logged."""
    log = SparingLog(name, logger)

    def run() -> None:
        while True:
            try:
                function()
            except Exception as error:  # pylint: disable=broad-except
                log_fault(log, error)

    threading.Thread(target=run, name=name, daemon=True).start()


def publish_diagnostics(links: Iterable[Link], logger: logging.Logger) -> None:
    """Publish the diagnostics of these links from now on.

    Each has an updater, since an updater has one hardware id and a link's is its port.
    """
    for link in links:
        _publish(link, logger)


def _publish(link: Link, logger: logging.Logger) -> None:
    def task(status: Any) -> Any:
        report = link.report(link.now())
        status.summary(report.level, report.summary)
        for key, value in report.values:
            status.add(key, str(value))
        return status

    def update() -> None:
        time.sleep(_PERIOD)
        updater.force_update()      # update() would count in ROS time, which may stop

    updater = Updater()
    updater.setHardwareID(link.port.url)
    updater.add(link.name + ' link', task)
    repeat(f'{link.name} diagnostics', update, logger)
