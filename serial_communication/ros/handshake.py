"""A connection that says nothing, or does not speak ROS, holds up nobody.

rospy reads what a connection begins with in the thread that accepts all the others, and waits for
it for ever: after a port scanner, or the master's call for a node of before whose port this one has
been given, no subscriber and no caller would be served any more. Here it waits for a while.

This is written against a private part of rospy, as it is in 1.15.15 (Debian 12) and 1.16.0
(Noetic). A rospy without it is left as it is, and says so.
"""
import logging
import socket
from typing import Any

from rosgraph.network import ROSHandshakeException
from rospy.impl import tcpros_base

_PATIENCE = 3.0     # s
_NAME = 'read_ros_handshake_header'


def install(logger: logging.Logger) -> None:
    """Have it so; to be called before anybody can connect."""
    read = getattr(tcpros_base, _NAME, None)
    if read is None:
        logger.warning('this rospy takes connections in another way than 1.15.15 and 1.16.0: one '
                       'that says nothing may hold up the others')
        return

    def read_in_time(connection: socket.socket, *arguments: Any) -> Any:
        if connection.gettimeout() is not None:     # one that this process makes
            return read(connection, *arguments)
        connection.settimeout(_PATIENCE)
        try:
            header = read(connection, *arguments)
        except socket.timeout:
            raise ROSHandshakeException(f'it has not begun as ROS does within {_PATIENCE:g} s') \
                from None
        connection.settimeout(None)
        return header

    setattr(tcpros_base, _NAME, read_in_time)
