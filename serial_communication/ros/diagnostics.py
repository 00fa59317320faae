"""Publishes /diagnostics: one status for each link, once a second by the monotonic clock."""
import time
from typing import Any

from diagnostic_updater import Updater

from ..link.link import Link
from .background import repeat

_PERIOD = 1.0   # s


def publish_diagnostics(link: Link) -> None:
    """Publish the diagnostics of a link from now on.

    Each has an updater, since an updater has one hardware id and a link's is its port.
    """
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
    repeat(f'{link.name} diagnostics', update)
