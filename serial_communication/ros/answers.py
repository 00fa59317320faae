"""Outcomes of bus calls in service responses: the bridge writes them, callers read them.

An outcome fills the fields `success`, `status`, `error_code` and `message` of a response, where its
type has them. Without a field `status`, the message of a failed call is the outcome's text. Without
a field `success`, a failed call raises a service error with that text.
"""
import ast
from typing import Any, List, Optional, Tuple

import rospy

from ..link.outcome import LOOK, TIMEOUT, Outcome, Verdict, read_text, verdict_of_failure

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
        raise service_error(outcome)
    for name in names:
        setattr(response, name, getattr(outcome, name))
    if not outcome.success and 'message' in names and 'status' not in names:
        response.message = outcome.text
    return response


def service_error(outcome: Outcome) -> rospy.ServiceException:
    """Return the service error for a failed call."""
    return rospy.ServiceException(outcome.text)


def read_response(response: Any) -> Tuple[Verdict, str]:
    """Return the verdict and the text of a response of the bridge; for callers."""
    names = outcome_fields(type(response))
    message = response.message if 'message' in names else ''
    if 'success' not in names or response.success:
        return Verdict.DONE, message or 'done'
    status, text = read_text(message)
    return _failure(response.status if 'status' in names else status, text)


def read_error(error: rospy.ServiceException) -> Tuple[Verdict, str]:
    """Return the verdict and the text of a service error; for callers."""
    if isinstance(error.__context__, rospy.TransportInitError):      # rospy had not connected yet
        return Verdict.REFUSED, 'nothing was sent: the bridge does not answer'
    text = str(error)
    quoted = text.partition(' responded with an error: ')[2]    # as bytes; '' without such a text
    try:
        text = ast.literal_eval(quoted).decode('utf-8', 'replace')
    except (AttributeError, SyntaxError, ValueError):
        text = quoted or f'no answer was received: {text}'
    return _failure(*read_text(text))


def _failure(status: Optional[int], text: str) -> Tuple[Verdict, str]:
    verdict = verdict_of_failure(status)
    if verdict is Verdict.NOT_KNOWN and status != TIMEOUT:      # a TIMEOUT's text has LOOK already
        text = f'{text or "no reason was given"}; {LOOK}'
    return verdict, text
