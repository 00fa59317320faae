"""How a mend tells whether the private parts of rospy that it changes are those it was written for.

They are the same in 1.15.15 (Debian 12) and 1.16.0 (Noetic). A rospy that differs is left as it is,
and a line says so.
"""
import inspect
from typing import Any, Callable, Iterable, Set


def are_known(as_expected: Callable[[], bool], does: str, consequence: str,
              warn: Callable[[str], None]) -> bool:
    """Whether a mend may be installed.

    Args:
        as_expected: looks at the private parts; may raise AttributeError where one is missing.
        does: what a rospy that differs does in another way.
        consequence: what people may see of that.
        warn: is called with a line for them.
    """
    try:
        if as_expected():
            return True
    except AttributeError:
        pass
    warn(f'this rospy {does} in another way than 1.15.15 and 1.16.0: {consequence}')
    return False


def names(members: Iterable[Any]) -> Set[str]:
    """What the functions among these use: globals, attributes and methods."""
    return {name for member in members if inspect.isfunction(member)
            for name in member.__code__.co_names}
