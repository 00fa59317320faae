"""Starts a node even if its log file cannot be written.

rospy.init_node raises an error if the log file belongs to another user (after a `sudo`) or the disk
has no free inode. If it cannot create the folder, it logs nothing at all, not even to the terminal.
Here the log goes to another file, or to the terminal alone, and its first line says so.
"""
import logging
import os
import tempfile
from typing import Any, List, Optional

import rosgraph.roslogging
import rospkg
import rospy

from .private_parts import Guard

_configure = rosgraph.roslogging.configure_logging
_GUARD = Guard('rospy.core:configure_logging rosgraph.roslogging:configure_logging '
               'rosgraph.roslogging:makedirs_with_parent_perms '
               'rosgraph.roslogging:RosStreamHandler', {'bca159f3f2171870'}, 'sets up logging',
               'programs do not start if the log file cannot be written')
_LOGGER = logging.getLogger('rosout')


def init_node(name: str, **arguments: Any) -> None:
    """Call `rospy.init_node`, and succeed even if the log file cannot be written."""
    warnings: List[str] = []    # logged below, once there is a log
    if _GUARD.passes(warnings.append):
        rosgraph.roslogging.configure_logging = _configure_with_fallback
    rospy.init_node(name, **arguments)
    for warning in warnings:
        _LOGGER.warning(warning)


def _configure_with_fallback(logname: str, level: int = logging.INFO,
                             filename: Optional[str] = None,
                             env: Optional[dict] = None) -> Optional[str]:
    """Replace rosgraph's function: log to the usual file, a file in a new folder, or no file."""
    filename = filename or f'{logname}-{os.getpid()}.log'
    usual = os.path.join(rospkg.get_log_dir(env=env), filename)
    try:
        _try(usual)
        return _configure(logname, level, filename, env)
    except Exception as error:  # pylint: disable=broad-except
        # A user's logging configuration may raise anything.
        why = f'the log cannot be written to {usual} ({getattr(error, "strerror", "") or error})'
    try:
        # The folder's name must not be predictable: another user could place a link there.
        folder = tempfile.mkdtemp(prefix='ros_log_')
        path = os.path.join(folder, os.path.basename(filename))
        _try(path)
        _configure(logname, level, os.path.basename(filename), {'ROS_LOG_DIR': folder})
    except Exception:  # pylint: disable=broad-except
        path = None
        _to_the_terminal()
    _LOGGER.warning('%s: it goes to %s. Check the owner and the free space (ls -l, df -i), or set '
                    'ROS_LOG_DIR', why, path or 'the terminal alone')
    return path


def _try(path: str) -> None:
    """Create the folders and the file; raise OSError if that fails."""
    folder = os.path.dirname(path)
    try:
        rosgraph.roslogging.makedirs_with_parent_perms(folder)
    except OSError:
        if not os.path.isdir(folder):
            raise       # otherwise it was created, and only the change of its owner failed
    with open(path, 'a'):
        pass


def _to_the_terminal() -> None:
    logging.getLogger().addHandler(logging.NullHandler())
    _LOGGER.handlers[:] = [rosgraph.roslogging.RosStreamHandler()]
    _LOGGER.setLevel(logging.INFO)
