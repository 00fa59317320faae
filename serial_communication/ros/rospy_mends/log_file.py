"""A log file that cannot be written stops no program: the log goes elsewhere, and says so.

rospy ends with a traceback where its log file belongs to somebody else (one `sudo` ago) or the
disk has no inode left, and says nothing at all, on the terminal either, where it cannot make the
folder.

This is written against private parts of rosgraph: see private_parts.py.
"""
import inspect
import logging
import os
import tempfile
from typing import Any, Optional

import rosgraph.roslogging
import rospkg
import rospy

from .private_parts import are_known

_configure = rosgraph.roslogging.configure_logging
_PARAMETERS = ['logname', 'level', 'filename', 'env']
_LOGGER = logging.getLogger('rosout')


def init_node(name: str, **arguments: Any) -> None:
    """`rospy.init_node`, whether its log file can be written or not."""
    warnings = []       # kept until there is a log
    if are_known(lambda: list(inspect.signature(_configure).parameters) == _PARAMETERS,
                 'sets up logging', 'where the log file cannot be written, programs do not start',
                 warnings.append):
        rosgraph.roslogging.configure_logging = _configure_anyhow
    rospy.init_node(name, **arguments)
    for warning in warnings:
        _LOGGER.warning(warning)


def _configure_anyhow(logname: str, level: int = logging.INFO, filename: Optional[str] = None,
                      env: Optional[dict] = None) -> Optional[str]:
    """In the place of rosgraph's: to the usual file, to one in a new folder, or to none."""
    filename = filename or f'{logname}-{os.getpid()}.log'
    usual = os.path.join(rospkg.get_log_dir(env=env), filename)
    try:
        _try(usual)
        return _configure(logname, level, filename, env)
    except Exception as error:  # pylint: disable=broad-except
        # Whatever a logging configuration of the user's own may raise, too.
        why = f'the log cannot be written to {usual} ({getattr(error, "strerror", "") or error})'
    try:
        # A new folder: what stands there under a known name may be a trap of another user's.
        folder = tempfile.mkdtemp(prefix='ros_log_')
        path = os.path.join(folder, os.path.basename(filename))
        _try(path)
        _configure(logname, level, os.path.basename(filename), {'ROS_LOG_DIR': folder})
    except Exception:  # pylint: disable=broad-except
        path = None
        _to_the_terminal()
    _LOGGER.warning('%s: it goes to %s. Look at owner and space (ls -l, df -i), or set ROS_LOG_DIR',
                    why, path or 'the terminal alone')
    return path


def _try(path: str) -> None:
    """Make the folders and the file; OSError where that cannot be."""
    folder = os.path.dirname(path)
    try:
        rosgraph.roslogging.makedirs_with_parent_perms(folder)
    except OSError:
        if not os.path.isdir(folder):
            raise       # else it was made, but not given to its parent's owner
    with open(path, 'a'):
        pass


def _to_the_terminal() -> None:
    logging.getLogger().addHandler(logging.NullHandler())
    _LOGGER.handlers[:] = [rosgraph.roslogging.RosStreamHandler()]
    _LOGGER.setLevel(logging.INFO)
