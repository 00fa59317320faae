"""Runs a program with port numbers and pseudo terminals of its own: apart.py COMMAND...

The system gives the numbers of ended programs to new ones. A bridge that waits for the port of an
ended board, or a node that still asks an ended ROS master, would reach the test that has its number
now. If the system does not allow it, the program runs as it would without this.
"""
import fcntl
import os
import socket
import struct
import subprocess
import sys

_SIOCSIFFLAGS = 0x8914
_IFF_UP = 1
_INSIDE = '--inside'


def main() -> None:
    """Become the command: in namespaces of its own, if they can be prepared."""
    command = sys.argv[1:]
    if command[0] == _INSIDE:
        prepare()
        command = command[1:]
    else:
        apart = ['unshare', '--net', '--mount', sys.executable, __file__, _INSIDE]
        if not subprocess.run([*apart, 'true'], stderr=subprocess.DEVNULL).returncode:
            command = [*apart, *command]
    os.execvp(command[0], command)


def prepare() -> None:
    """Give the new namespaces what programs need: the loopback interface and pseudo terminals."""
    if not socket.gethostbyname(socket.gethostname()).startswith('127.'):
        sys.exit("the new network does not have the address of this computer's name")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack('16sh14x', b'lo', _IFF_UP))
    subprocess.run(['mount', '-t', 'devpts', '-o', 'gid=5,mode=620,ptmxmode=666', 'devpts',
                    '/dev/pts'], check=True)


if __name__ == '__main__':
    main()
