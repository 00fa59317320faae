"""What a private part of rospy uses, by which a changed rospy is told from the known ones."""
import inspect
from typing import Any, Iterable, Set


def names(members: Iterable[Any]) -> Set[str]:
    """What the functions among these use: globals, attributes and methods."""
    return {name for member in members if inspect.isfunction(member)
            for name in member.__code__.co_names}
