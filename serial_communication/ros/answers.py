"""Outcomes of calls in service responses.

An outcome fills the fields `success`, `status`, `error_code` and `message` of a response, where its
type has them. Without a field `success`, a failed call is a service error with the message.
"""
from typing import Any, List

import rospy

from ..link.outcome import Outcome

_FIELD_TYPES = {'success': ('bool',), 'status': ('uint8', 'uint16', 'uint32', 'int16', 'int32'),
                'error_code': ('uint16', 'uint32', 'int32'), 'message': ('string',)}


def outcome_fields(response_class: Any) -> List[str]:
    """Return the names of the fields of a response that an outcome fills."""
    types = dict(zip(response_class.__slots__, response_class._slot_types))
    return [name for name, fitting in _FIELD_TYPES.items() if types.get(name) in fitting]


def fill_response(response: Any, outcome: Outcome) -> Any:
    """Write an outcome into a response, and return the response; rospy.ServiceException if the call
    failed and the response has no field `success`."""
    names = outcome_fields(type(response))
    if not outcome.success and 'success' not in names:
        raise rospy.ServiceException(outcome.message)
    for name in names:
        setattr(response, name, getattr(outcome, name))
    return response
