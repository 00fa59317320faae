"""Outcomes of calls in service responses: the bridge writes them, callers read them.

An outcome fills the fields `success`, `status`, `error_code` and `message` of a response, where its
type has them. Without a field `success`, a failed call is a service error with the message.
"""
from typing import Any, List, Tuple

import rospy
from rospy.exceptions import TransportException, TransportInitError

from ..link.outcome import LOOK, Outcome, Verdict, verdict_of_failure

_FIELD_TYPES = {'success': ('bool',), 'status': ('uint8', 'uint16', 'uint32', 'int16', 'int32'),
                'error_code': ('uint16', 'uint32', 'int32'), 'message': ('string',)}


def outcome_fields(response_class: Any) -> List[str]:
    """Return the names of the fields of a response that an outcome fills."""
    types = dict(zip(response_class.__slots__, response_class._slot_types))
    return [name for name, fitting in _FIELD_TYPES.items() if types.get(name) in fitting]


def fill_response(response: Any, outcome: Outcome) -> Any:
    """Write an outcome into a response, and return the response.

    Raises:
        rospy.ServiceException: the call failed, and the response has no field `success`.
    """
    names = outcome_fields(type(response))
    if not outcome.success and 'success' not in names:
        raise rospy.ServiceException(outcome.message)
    for name in names:
        setattr(response, name, getattr(outcome, name))
    return response


def read_response(response: Any) -> Tuple[Verdict, str]:
    """Return the verdict and the message of a response of the bridge; for callers.

    Without a field `status`, a failure counts as refused; its message has the rest.
    """
    names = outcome_fields(type(response))
    message = response.message if 'message' in names else ''
    if 'success' not in names or response.success:
        return Verdict.DONE, message or 'done'
    return (verdict_of_failure(response.status) if 'status' in names else Verdict.REFUSED), message


def read_error(error: rospy.ServiceException) -> Tuple[Verdict, str]:
    """Return the verdict and the text of a service error; for callers."""
    if isinstance(error.__context__, TransportInitError):      # rospy had not connected yet
        return Verdict.REFUSED, 'nothing was sent: the bridge does not answer'
    if isinstance(error.__context__, TransportException):
        return Verdict.NOT_KNOWN, f'no answer was received: {error}; {LOOK}'
    return Verdict.REFUSED, str(error)
