"""A TCP server in front of a board, as a converter on a robot is, with a network that fails."""
import os
import pty
import select
import socket
import threading
import time
import tty
from typing import List, Optional

from .records import Lines

_SIZE = 65536
_GONE = select.POLLERR | select.POLLHUP | select.POLLRDHUP


class Relay(threading.Thread):
    """Passes bytes between one connection and a board at a pseudo terminal.

    What a frozen network holds of a connection that has ended meanwhile is lost with it.

    Args:
        events: are told when it freezes, thaws and forgets, for a link `network`.
    """

    def __init__(self, events: Lines) -> None:
        super().__init__(name='network', daemon=True)
        self._events = events
        self._listener = socket.create_server(('127.0.0.1', 0))
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.url = f'socket://127.0.0.1:{self._listener.getsockname()[1]}'
        self.board = os.ttyname(self._slave)
        self._connection: Optional[socket.socket] = None
        self._forgotten: List[socket.socket] = []
        self._forget = self._frozen = self._ending = False

    def freeze(self) -> None:
        """Nothing gets through, in no direction; new connections neither."""
        self._frozen = True
        self._events.write(t=time.monotonic(), ev='frozen', link='network')

    def thaw(self) -> None:
        """It is as before."""
        self._events.write(t=time.monotonic(), ev='thawed', link='network')
        self._frozen = False

    def vanish(self) -> None:
        """The peer knows nothing of its connection any more, and says nothing, not even that."""
        self._forget = True
        self._events.write(t=time.monotonic(), ev='vanished', link='network')

    def close(self) -> None:
        """End."""
        self._ending = True
        self.join()
        for one in self._forgotten + [self._listener] + (
                [self._connection] if self._connection else []):
            one.close()
        for fd in self._master, self._slave:
            os.close(fd)

    def run(self) -> None:
        while not self._ending:
            if self._forget and self._connection:
                self._forgotten.append(self._connection)
                self._connection = None
            self._forget = False
            if self._frozen:
                time.sleep(0.01)
            elif self._connection is None:
                self._accept()
            else:
                self._pass_on(self._connection)

    def _accept(self) -> None:
        if select.select([self._listener], [], [], 0.05)[0]:
            self._connection, _address = self._listener.accept()
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _pass_on(self, connection: socket.socket) -> None:
        poll = select.poll()
        poll.register(connection, select.POLLIN | select.POLLRDHUP)
        poll.register(self._master, select.POLLIN)
        ready = dict(poll.poll(50))
        if self._frozen or self._forget:
            return
        at_connection = ready.get(connection.fileno(), 0)
        try:
            if at_connection & _GONE:
                raise ConnectionResetError
            if self._master in ready:
                connection.sendall(os.read(self._master, _SIZE))
            if at_connection & select.POLLIN:
                os.write(self._master, connection.recv(_SIZE))
        except OSError:
            connection.close()
            self._connection = None
