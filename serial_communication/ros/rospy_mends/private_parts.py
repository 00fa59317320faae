"""The check of the private parts of rospy and rosgraph that this package replaces or relies on.

Each patch names these functions and classes. Their source must be one that was looked at: that of
1.15.15 (Debian 12) or 1.16.0 (Noetic), where all of them are the same. Where one differs, rospy is
not patched and works as it is, and a warning says what that means.

Run as a program, this module prints the table for the installed rospy.
"""
import hashlib
import importlib
import inspect
from operator import attrgetter
from typing import Callable, Dict, Iterable, Set

# By MODULE:NAME, a hash for each source that was looked at.
SOURCES: Dict[str, Set[str]] = {
    'rosgraph.network:decode_ros_handshake_header': {'61af3ca07d826cd0'},
    'rosgraph.roslogging:RosStreamHandler': {'77c29fb1fe2fb177'},
    'rosgraph.roslogging:configure_logging': {'9bb4464810dea8c7'},
    'rosgraph.roslogging:makedirs_with_parent_perms': {'fca6dd2e452b550b'},
    'rosgraph.xmlrpc:ThreadingXMLRPCServer': {'48c00765378e43dc'},
    'rospy.client:load_command_line_node_params': {'fe36385572c50e51'},
    'rospy.core:_LockedServerProxy': {'61aa2aaa84700709'},
    'rospy.core:_ros_atexit': {'b3abd4c892cdfafd'},
    'rospy.core:add_preshutdown_hook': {'0080ad9813506d86'},
    'rospy.core:configure_logging': {'07ce2e8621747a40'},
    'rospy.core:is_shutdown_requested': {'6a884da3e11c6869'},
    'rospy.core:signal_shutdown': {'3867acf58e86ed4d'},
    'rospy.core:xmlrpcapi': {'6b1fc09719cb791a'},
    'rospy.impl.registration:RegManager.publisher_update': {'aa755d056b6ef4cb'},
    'rospy.impl.registration:RegManager.run': {'81755607e15733a1'},
    'rospy.impl.registration:RegistrationListeners.add_listener': {'e347e96c61584aee'},
    'rospy.impl.tcpros_base:TCPROSServer._tcp_server_callback': {'9b8492fb23e3011b'},
    'rospy.impl.tcpros_base:TCPROSTransport.__init__': {'ffd44df96ec1a201'},
    'rospy.impl.tcpros_base:TCPROSTransport.close': {'ab7ae82204ef7b68'},
    'rospy.impl.tcpros_base:TCPROSTransport.connect': {'ff20a0d028158aad'},
    'rospy.impl.tcpros_base:TCPROSTransport.read_header': {'21fe75844b593e9d'},
    'rospy.impl.tcpros_base:TCPROSTransport.receive_once': {'4464d20639739af6'},
    'rospy.impl.tcpros_base:TCPServer.run': {'071bb9921596fdb9'},
    'rospy.impl.tcpros_base:TCPServer.shutdown': {'771a0bca2d4e0d91'},
    'rospy.impl.tcpros_base:read_ros_handshake_header': {'ed3438f31c6f23ed'},
    'rospy.impl.tcpros_pubsub:TCPROSHandler.create_transport': {'ade7b99fcd4ca576'},
    'rospy.impl.tcpros_service:ServiceProxy.__init__': {'d690ed97ab945545'},
    'rospy.impl.tcpros_service:ServiceProxy.call': {'5c851b54ff16b3d2'},
    'rospy.impl.transport:Transport.__init__': {'13ab15cdb28c2400'},
    'rospy.impl.transport:Transport.close': {'3771d1166ea316a0'},
    'rospy.service:ServiceManager.get_service': {'42befaddc5c9b5f7'},
    'rospy.service:ServiceManager.get_services': {'ad5ab340412c7a76'},
    'rospy.service:ServiceManager.register': {'15941d87dbc2f5b4'},
    'rospy.topics:QueuedConnection': {'edf2c9e63035fbbe'},
    'rospy.topics:_PublisherImpl.add_connection': {'0d180d4068ed7b62'},
    'rospy.topics:_PublisherImpl.publish': {'e21902dd4a6f78dc'},
    'rospy.topics:_TopicImpl._remove_connection': {'8764b1cbcd2aaad9'},
    'rospy.topics:_TopicImpl.add_connection': {'6323cacf86f0d5df'},
    'rospy.topics:_TopicImpl.has_connection': {'914c6f8ca71ff700'},
    'rospy.topics:_TopicManager.acquire_impl': {'9cac3429dcf29b55'},
    'rospy.topics:_TopicManager.get_publications': {'194b10089268fb81'},
    'rospy.topics:_TopicManager.get_subscriptions': {'849f79f68bb1ca6d'},
}


def are_known(parts: Iterable[str], does: str, consequence: str,
              warn: Callable[[str], None]) -> bool:
    """Return whether a patch may be installed; otherwise warn.

    Args:
        parts: what it replaces or relies on, each in the table.
        does: what this rospy does differently; a verb such as ``sends messages``.
        consequence: the effect on users.
        warn: called with the warning, one line.
    """
    try:
        if all(source_hash(part) in SOURCES[part] for part in parts):
            return True
    except (AttributeError, ImportError, OSError):
        pass        # a part is missing, or is installed without its source
    warn(f'this rospy {does} differently from 1.15.15 and 1.16.0: {consequence}')
    return False


def source_hash(part: str) -> str:
    """Return the hash of the source of a function, or of all methods of a class."""
    module, _, name = part.partition(':')
    found = attrgetter(name)(importlib.import_module(module))
    members = vars(found).values() if inspect.isclass(found) else [found]
    source = ''.join(inspect.getsource(each) for each in members if inspect.isfunction(each))
    return hashlib.sha256(source.encode()).hexdigest()[:16]


if __name__ == '__main__':
    for _part in SOURCES:
        print(f'    {_part!r}: {{{source_hash(_part)!r}}},')
