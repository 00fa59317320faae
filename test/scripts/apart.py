"""Runs a program with port numbers and pseudo terminals of its own: apart.py COMMAND...

The system gives the numbers of ended programs to new ones. A bridge that waits for the port of an
ended board, or a node that still asks an ended ROS master, would reach the test that has its number
now. To be run by `unshare --net --mount`; ends with an error if the system does not allow it.
"""
import fcntl
import os
import socket
import struct
import subprocess
import sys

_SIOCSIFFLAGS = 0x8914
_IFF_UP = 1


def main() -> None:
    """Prepare the namespaces and become the command."""
    if not socket.gethostbyname(socket.gethostname()).startswith('127.'):
        sys.exit("the new network does not have the address of this computer's name")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack('16sh14x', b'lo', _IFF_UP))
    subprocess.run(['mount', '-t', 'devpts', '-o', 'gid=5,mode=620,ptmxmode=666', 'devpts',
                    '/dev/pts'], check=True)
    os.execvp(sys.argv[1], sys.argv[1:])


if __name__ == '__main__':
    main()
