"""Calls a service of the bridge, now or never."""
import enum
import time
from typing import Any, NamedTuple, Tuple

import rosgraph
import rospy
from rospy.exceptions import TransportException, TransportInitError

from ...link.outcome import LOOK, NOT_SENT
from ...ros.fields import outcome_fields

MOST_WAIT = 2.0     # s for the bridge to answer
_REFUSED = NOT_SENT, 3, 255      # statuses of a call that was not executed: also ERROR, INVALID


def node_argument(name: str) -> str:
    """For argparse: a node's full name. A name without / is in this shell's ROS_NAMESPACE."""
    return rosgraph.names.resolve_name(name.rstrip('/'),
                                       rosgraph.names.get_ros_namespace() + 'a_program')


class Verdict(enum.Enum):
    """Whether a call was executed."""

    DONE = 'done'              # executed; exactly once, unless it may be repeated
    REFUSED = 'refused'        # not executed
    FAILED = 'failed'          # the message alone says whether it was executed
    NOT_KNOWN = 'not known'    # executed once or not at all, unless it may be repeated


class Answer(NamedTuple):
    """The answer to a service call."""

    outcome: Verdict
    words: str              # describes the outcome
    response: Any = None    # None: there is none


def call(name: str, service_class: Any, request: Any, deadline: float) -> Answer:
    """Call a service and return its answer; may take as long as the service.

    Args:
        name: full name.
        deadline: a time of the monotonic clock, after which nothing is sent any more: the robot
            would move when nobody expects it.
    """
    try:
        rosgraph.Master(rospy.get_name()).lookupService(name)
        rospy.wait_for_service(name, MOST_WAIT)
    except rosgraph.MasterException:
        return Answer(Verdict.REFUSED, 'nothing was sent: no bridge offers this service now')
    except (OSError, rospy.ROSException):
        return Answer(Verdict.REFUSED, 'nothing was sent: the bridge or the ROS master does not '
                      'answer')
    if time.monotonic() > deadline:
        return Answer(Verdict.REFUSED, 'nothing was sent: master and bridge took more than '
                      f'{MOST_WAIT:g} s to answer; call again')
    try:
        response = rospy.ServiceProxy(name, service_class)(request)
        return Answer(*read_response(response), response)
    except rospy.ServiceException as error:
        return Answer(*read_error(error))
    except Exception as error:  # pylint: disable=broad-except
        return Answer(Verdict.NOT_KNOWN, f'the call failed: {error}; {LOOK}')


def read_response(response: Any) -> Tuple[Verdict, str]:
    """Return the verdict and the message of a response of the bridge."""
    names = outcome_fields(type(response))
    message = response.message if 'message' in names else ''
    if 'success' not in names or response.success:
        return Verdict.DONE, message or 'done'
    if 'status' not in names:
        return Verdict.FAILED, message
    return Verdict.REFUSED if response.status in _REFUSED else Verdict.NOT_KNOWN, message


def read_error(error: rospy.ServiceException) -> Tuple[Verdict, str]:
    """Return the verdict and the text of a service error."""
    if isinstance(error.__context__, TransportInitError):      # rospy had not connected yet
        return Verdict.REFUSED, 'nothing was sent: the bridge does not answer'
    if isinstance(error.__context__, TransportException):
        return Verdict.NOT_KNOWN, f'no answer was received: {error}; {LOOK}'
    return Verdict.FAILED, str(error)
