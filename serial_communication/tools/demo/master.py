"""Before scripts/demo launches: can roslaunch use the ROS master, and does no bridge run there?"""
import socket
import sys
import threading
import urllib.parse
from typing import List

import rosgraph

from ...ros.master import running_node
from ..watch.topics import NODE

_PATIENCE = 10.0    # s for each answer
_OWN, _OTHER = 'http://localhost:11311', 'http://localhost:11312'


def problem() -> str:
    """Return why nothing can be launched, with what to do, as one line; '' if it can."""
    uri = rosgraph.get_master_uri()
    said: List[str] = []
    asking = threading.Thread(target=lambda: said.append(_trouble(uri)), daemon=True)
    asking.start()      # an unreachable host may take minutes to fail
    asking.join(_PATIENCE)
    trouble = said[0] if said else f'no answer within {_PATIENCE:.0f} s'
    if trouble:
        mend = 'unset ROS_MASTER_URI' if uri != _OWN else f'export ROS_MASTER_URI={_OTHER}'
        return f'no ROS master answers at {uri}: {trouble}. For a master of its own:  {mend}'
    if running_node(NODE):
        return f'a bridge already runs at {uri}; end it first, or set ROS_MASTER_URI to another ' \
            f'port, such as {_OTHER}.'
    return ''


def _trouble(uri: str) -> str:
    """Why the master cannot be used; '' if it answers, or if roslaunch starts it."""
    host = urllib.parse.urlsplit(uri).hostname
    if not host:
        return f'it is no address such as {_OWN}'
    try:
        rosgraph.Master(NODE).getPid()
    except socket.gaierror:
        return f'the name {host} cannot be resolved'
    except ConnectionRefusedError as error:
        return '' if rosgraph.network.is_local_address(host) else error.strerror.lower()
    except OSError as error:
        return (error.strerror or str(error)).lower()
    except Exception:  # pylint: disable=broad-except
        return 'what answers there is no ROS master'
    return ''


if __name__ == '__main__':
    print(problem(), flush=True)
    sys.exit()
