"""The interface between the node and a board."""
from typing import Any, Dict, Optional, Tuple

import rospy

from ..link.link import Link
from ..transport.port import Port
from .binder import Binder
from .parameter import Parameters


def link_arguments(p: Dict[str, Any]) -> Dict[str, Any]:
    """Arguments of a `Link`, from the parameters of its board: all but the session."""
    return {'port': Port(p['port'], p['baud'], p.get('reset_on_open', False)),
            'frame_timeout': p['frame_timeout'], 'clock': rospy.Time.now, 'earlier': _earlier,
            'board_time': p.get('board_time', True)}


def _earlier(stamp: rospy.Time, seconds: float) -> rospy.Time:
    """Return the time so many seconds before `stamp`; ROS has none before 0."""
    return rospy.Time(0, max(stamp.to_nsec() - int(seconds * 1e9), 0))


class Interface:
    """One board on the ROS side: its parameters and frames, its link, its topics and services.

    The module `ros` of a board has a subclass as `INTERFACE`. The node checks the board's
    parameters, creates the interface if the board has a port, publishes its mounts, and starts its
    link. Diagnostics and serial_msg need only the link.

    Args:
        p: the checked values of `PARAMETERS`, and of publish_tf, base_frame_id,
            frame_timeout and frame_prefix. Frame ids have the prefix already.
    """

    NAME: str                      # of the link, in logs, diagnostics, serial_msg and parameters
    PARAMETERS: Parameters         # including `port` and `baud`
    MOUNTS: Tuple[str, ...] = ()   # for each sensor x, x_frame_id and x_mount are parameters
    link: Link
    binder: Optional[Binder] = None    # None: the board has no rows

    def __init__(self, p: Dict[str, Any]) -> None:
        """Create the link, and what needs code of its own; ParameterError ends the node."""
