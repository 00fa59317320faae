"""A node's shutdown: whether it has begun, why, and an end that does not wait for the master."""
import atexit
import threading
from typing import Callable

import rospy

from .private_parts import Guard

_GUARD = Guard('rospy.core:is_shutdown_requested rospy.core:add_preshutdown_hook '
               'rospy.core:signal_shutdown rospy.core:_ros_atexit', {'6c985b49832181a1'},
               'shuts down', 'a node whose name another one took is not started again, and a '
               'program may end late')


def is_shutdown_requested() -> bool:
    """Return whether the shutdown has begun; rospy.is_shutdown says so only after the hooks."""
    return bool(rospy.core.is_shutdown_requested() if _GUARD.passes() else rospy.is_shutdown())


def on_shutdown(hook: Callable[[str], None]) -> None:
    """Call this with the reason when the shutdown begins, while the node can still log."""
    if _GUARD.passes():
        rospy.core.add_preshutdown_hook(hook)


def leave_ros(patience: float = 2.0) -> None:
    """Shut this process's node down, in `patience` s at most even if the master hangs."""
    ending = threading.Thread(target=rospy.signal_shutdown, args=('it ends',), daemon=True)
    ending.start()
    ending.join(patience)
    if ending.is_alive() and _GUARD.passes():
        atexit.unregister(rospy.core._ros_atexit)    # it would wait for the master
