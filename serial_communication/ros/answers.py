"""Outcomes in the responses and errors of services, as the bridge writes and callers read them.

A response's fields `success`, `status`, `error_code` and `message` are filled where its type has
them. Where it has no `status`, the message of a failure is the outcome's text; where it has no
`success`, a failure is a service error with that text.
"""
import ast
from typing import Any, List, Tuple

import rospy
from rospy.exceptions import TransportInitError

from ..link.outcome import LOOK, TIMEOUT, Outcome, Verdict, read_text, verdict_of_failure

_TOLD = {'success': ('bool',), 'status': ('uint8', 'uint16', 'uint32', 'int16', 'int32'),
         'error_code': ('uint16', 'uint32', 'int32'), 'message': ('string',)}


def told_fields(response_class: Any) -> List[str]:
    """The fields of a response that an outcome fills."""
    types = dict(zip(response_class.__slots__, response_class._slot_types))
    return [name for name, fitting in _TOLD.items() if types.get(name) in fitting]


def tell(response: Any, outcome: Outcome) -> Any:
    """Fill a response with an outcome; return it.

    Raises:
        rospy.ServiceException: the call did not succeed, and the response cannot say so.
    """
    names = told_fields(type(response))
    if not outcome.success and 'success' not in names:
        raise service_error(outcome)
    for name in names:
        setattr(response, name, getattr(outcome, name))
    if not outcome.success and 'message' in names and 'status' not in names:
        response.message = outcome.text
    return response


def service_error(outcome: Outcome) -> rospy.ServiceException:
    """The service error of a call that did not succeed."""
    return rospy.ServiceException(outcome.text)


def read_response(response: Any) -> Tuple[Verdict, str]:
    """For a caller: what a response of the bridge says."""
    names = told_fields(type(response))
    message = response.message if 'message' in names else ''
    if 'success' not in names or response.success:
        return Verdict.DONE, message or 'done'
    status, words = read_text(message)
    return _failure(response.status if 'status' in names else status, words)


def read_error(error: rospy.ServiceException) -> Tuple[Verdict, str]:
    """For a caller: what the error of a call says."""
    if isinstance(error.__context__, TransportInitError):      # rospy had not connected yet
        return Verdict.REFUSED, 'nothing was sent: the bridge does not answer'
    return _failure(*read_text(_said(error)))


def _failure(status: Any, words: str) -> Tuple[Verdict, str]:
    verdict = verdict_of_failure(status)
    if verdict is Verdict.NOT_KNOWN and status != TIMEOUT:      # … whose message says so itself
        words = f'{words or "it gave no reason"}; {LOOK}'
    return verdict, words


def _said(error: rospy.ServiceException) -> str:
    """What the other end said, which rospy quotes as bytes; else what rospy says itself."""
    text = str(error)
    quoted = text.partition(' responded with an error: ')[2]
    try:
        return ast.literal_eval(quoted).decode('utf-8', 'replace')
    except (AttributeError, SyntaxError, ValueError):
        return quoted or f'no answer came: {text}'
