"""The interface between the node and a board."""
import logging
import operator
from typing import Any, Callable, Dict, NamedTuple, Optional, Tuple

from ..link.link import Link
from ..link.session import Session
from ..link.sparing_log import SparingLog
from ..transport.port import Port
from .binder import Binder
from .parameter import Parameters


class LinkOptions(NamedTuple):
    """What the node gives to every link."""

    frame_timeout: float           # s
    clock: Callable[[], Any]       # returns the rospy.Time that stamps a read
    logger: logging.Logger
    # Returns the stamp so many seconds before a stamp of `clock`.
    earlier: Callable[[Any, float], Any] = operator.sub

    def log(self, name: str) -> SparingLog:
        """The log of a board's session."""
        return SparingLog(name, self.logger)

    def link(self, port: Port, session: Session, board_time: bool = True) -> Link:
        """The link that serves a session."""
        return Link(port, session, self.frame_timeout, self.clock, self.earlier, board_time)


class Interface:
    """One board on the ROS side: its parameters and frames, its link, its topics and services.

    The module `ros` of a board has a subclass as `INTERFACE`. The node checks the board's
    parameters, creates the interface if the board has a port, publishes its mounts, starts its
    link, and then calls `advertise`. Diagnostics and serial_msg need only the link.

    Args:
        parameters: the checked values of `PARAMETERS`, and of publish_tf, base_frame_id and
            frame_prefix. Frame ids have the prefix already.
        link_options: makes the log and the link.
    """

    NAME: str                      # of the link, in logs, diagnostics, serial_msg and parameters
    PARAMETERS: Parameters         # including `port` and `baud`
    MOUNTS: Tuple[str, ...] = ()   # for each sensor x, x_frame_id and x_mount are parameters
    link: Link
    binder: Optional[Binder] = None    # None: the board has no rows

    def __init__(self, parameters: Dict[str, Any], link_options: LinkOptions) -> None:
        """Create the link and the topics from the board; ParameterError ends the node."""

    def advertise(self) -> None:
        """Offer what needs code of its own; the rows are there."""
