"""Checks that the private parts of rospy which a patch changes are those that it was written for.

They are the same in 1.15.15 (Debian 12) and 1.16.0 (Noetic). A rospy that differs is not patched,
and a warning is logged.
"""
import inspect
from typing import Any, Callable, Iterable, Set


def are_known(as_expected: Callable[[], bool], does: str, consequence: str,
              warn: Callable[[str], None]) -> bool:
    """Return whether a patch may be installed; otherwise warn.

    Args:
        as_expected: checks the private parts; may raise AttributeError if one is missing.
        does: what this rospy does differently; a verb such as ``sends messages``.
        consequence: the effect on users.
        warn: called with the warning, one line.
    """
    try:
        if as_expected():
            return True
    except AttributeError:
        pass
    warn(f'this rospy {does} differently from 1.15.15 and 1.16.0: {consequence}')
    return False


def names(members: Iterable[Any]) -> Set[str]:
    """Return the globals, attributes and methods that the functions among `members` use."""
    return {name for member in members if inspect.isfunction(member)
            for name in member.__code__.co_names}
