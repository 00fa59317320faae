"""What a board must be to the node."""
import logging
from typing import Any, Callable, Dict, List, NamedTuple, Protocol, Tuple

from ..link.link import Link
from .parameter import Parameters


class Common(NamedTuple):
    """What every link is given by the node: arguments of `Link`."""

    frame_timeout: float           # s
    clock: Callable[[], Any]       # stamps each read with a rospy.Time
    logger: logging.Logger


class Interface(Protocol):
    """One board on the ROS side: its parameters and frames, its link, its topics and services.

    A subclass stands as `INTERFACE` in its module. The node checks the board's parameters, makes
    the interface if the board has a port, publishes where its frames stand, starts its link,
    and then calls `advertise`. Diagnostics and serial_msg follow from the link.

    Args:
        parameters: the checked values: the board's own by their names in `PARAMETERS`, beside them
            publish_tf, base_frame_id and frame_prefix. Frame ids have the prefix already.
        common: to be passed on to the link.
    """

    NAME: str                      # of the link, in logs, diagnostics, serial_msg and parameters
    PARAMETERS: Parameters         # `port` and `baud` among them
    MOUNTS: Tuple[str, ...] = ()   # x, where a sensor stands: x_frame_id and x_mount are parameters
    link: Link

    def __init__(self, parameters: Dict[str, Any], common: Common) -> None:
        ...

    @staticmethod
    def problem(parameters: Dict[str, Any]) -> str:
        """What no single parameter can tell, beginning with the name of one; '' if all is well."""
        return ''

    @staticmethod
    def custom_names(parameters: Dict[str, Any]) -> List[Tuple[str, str]]:
        """The topics and services that parameters add: (name, the parameter that adds it)."""
        return []

    def advertise(self) -> None:
        """Subscribe and offer services; the link runs already."""
