"""The guard of each patch: it compares the source of the private parts that the patch needs.

All of them are the same in 1.15.15 (Debian 12) and 1.16.0 (Noetic). Where one differs, rospy is not
patched and works as it is, and a warning says what that means. A new version that was looked at
adds the hash that `source_hash` returns there.
"""
import hashlib
import importlib
import inspect
import logging
from operator import attrgetter
from typing import Callable, Optional, Set

_LOGGER = logging.getLogger('rosout')


class Guard:
    """Says whether a patch may be used.

    Args:
        parts: the functions and classes that it replaces or relies on: MODULE:NAME, with spaces.
        sources: a hash for each version of their source that was looked at.
        does: what another rospy does differently; a verb such as ``sends messages``.
        consequence: the effect on users.
    """

    def __init__(self, parts: str, sources: Set[str], does: str, consequence: str) -> None:
        self.parts = parts.split()
        self._sources = sources
        self._warning = f'this rospy {does} differently from 1.15.15 and 1.16.0: {consequence}'
        self._passed: Optional[bool] = None     # not checked yet

    def passes(self, warn: Callable[[str], None] = _LOGGER.warning) -> bool:
        """Return whether the source is known; if not, call `warn` once. Call it before the patch.

        It is checked at the first call.
        """
        if self._passed is None:
            try:
                self._passed = self.source_hash() in self._sources
            except (AttributeError, ImportError, OSError):
                self._passed = False    # a part is missing, or is installed without its source
            if not self._passed:
                warn(self._warning)
        return self._passed

    def source_hash(self) -> str:
        """Return the hash of the source of all functions, and of all methods of the classes."""
        return hashlib.sha256(''.join(map(_source, self.parts)).encode()).hexdigest()[:16]


def _source(part: str) -> str:
    module, _, name = part.partition(':')
    found = attrgetter(name)(importlib.import_module(module))
    members = vars(found).values() if inspect.isclass(found) else [found]
    return ''.join(inspect.getsource(each) for each in members if inspect.isfunction(each))
