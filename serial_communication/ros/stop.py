"""The service ~stop: stops all that moves, and keeps it stopped until it is released."""
from typing import Sequence

import rospy
from std_srvs.srv import SetBool, SetBoolRequest, SetBoolResponse

from ..link.writer import STALLED
from ..link.link import Link


class Stop:
    """~stop of all links.

    Args:
        links: in the order in which they are stopped.
        holds: whether it is held from the start.
    """

    def __init__(self, links: Sequence[Link], holds: bool = False) -> None:
        self.holds = holds
        self._links = links
        self._set(holds)

    def advertise(self) -> None:
        """Offer the service."""
        rospy.Service('~stop', SetBool, self._handle)

    def _handle(self, request: SetBoolRequest) -> SetBoolResponse:
        if request.data:
            self._set(True)      # of all links first: from now on nothing moves again
            failures = [f'{link.name}: {failure}' for link in self._links
                        for failure in [link.stop_motion()] if failure]
            rospy.logwarn('~stop: all that moves is stopped until ~stop is called with data: '
                          + '; '.join(['false', *failures]))
            return SetBoolResponse(not failures, '; '.join(failures) or 'stopped')
        if not all(link.writer.fresh.is_fresh(link.now()) for link in self._links):
            return SetBoolResponse(False, STALLED)
        if self.holds:
            rospy.loginfo('~stop: released')
        self._set(False)
        return SetBoolResponse(True, 'released')

    def _set(self, holds: bool) -> None:
        self.holds = holds
        for link in self._links:
            link.session.is_stopped = holds
