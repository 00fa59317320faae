"""The web server: who looks, and what each is sent."""
import logging
import socket
import time
import traceback
from typing import Any, Dict, List, Optional, Set

import tornado.httpserver
import tornado.ioloop
import tornado.netutil
import tornado.web

from ...link.sparing_log import SparingLog
from .commands import Commands
from .feed import Feed
from .guard import Guard
from .pages import WEB, Files
from .session import LONGEST, Session, encode

PERIOD = 0.04          # s from one update to the next
_MOST_PAGES = 16
_MOST_CONNECTIONS = 64     # pages and all others; a browser has up to 6 while it loads a page
_GRACE = 1.0           # s that all goes on after the last page has gone: it may only be loading
_HEADERS = 16384       # bytes of a request


class Hub:
    """Everybody who looks, and what they look at."""

    def __init__(self, feed: Feed, commands: Optional[Commands], log: SparingLog) -> None:
        self.commands = commands
        self.log = log
        self._feed = feed
        self._pages: Set[Session] = set()
        self._ready = False          # ROS can be used
        self._looking = False
        self._timer = tornado.ioloop.PeriodicCallback(self._tick, PERIOD * 1e3)

    def ros_is_there(self) -> None:
        """rospy.init_node has returned."""
        self._ready = True
        self._look()

    def streams(self) -> Set[Any]:
        """The connections of the pages."""
        return {page.stream for page in self._pages}

    def full(self) -> bool:
        """Whether nobody else may look."""
        return len(self._pages) >= _MOST_PAGES

    def add(self, page: Session) -> None:
        """A page has been opened."""
        self._pages.add(page)
        self._look()
        if not self._timer.is_running():
            self._timer.start()

    def remove(self, page: Session) -> None:
        """A page has gone."""
        if page not in self._pages:
            return
        self._pages.discard(page)
        if self.commands:
            self.commands.forget(page)
        self.watch()
        if not self._pages:
            tornado.ioloop.IOLoop.current().call_later(_GRACE, self._look_away)

    def watch(self) -> None:
        """Subscribe to what the pages show, all together."""
        if self._pages:
            self._feed.want(frozenset().union(*(page.topics for page in self._pages)))

    def stop(self) -> bool:
        """The panel ends: the car stands; whether it was told so just now."""
        drove = bool(self.commands and self.commands.stop_driving())
        self._pages.clear()
        return drove

    def _look(self) -> None:
        if self._ready and self._pages and not self._looking:
            self._looking = True
            self._feed.start()
            if self.commands:
                self.commands.start()

    def _look_away(self) -> None:
        if self._pages:
            return
        self._timer.stop()
        if self._looking:
            self._looking = False
            self._feed.stop()
            if self.commands:
                self.commands.stop()

    def _tick(self) -> None:
        try:
            self._update()
        except Exception:  # pylint: disable=broad-except
            # A fault of ours must not leave the pages silent without a word about why.
            self.log.error('fault', traceback.format_exc())
            now = time.monotonic()
            text = encode({'now': round(now, 4), 'trouble': 'a fault of the panel; see its log'})
            for page in list(self._pages):
                page.send(now, text)

    def _update(self) -> None:
        now = time.monotonic()
        update, wire = self._feed.take(now)
        if self.commands:
            update.update(self.commands.take(self._feed.state))
        plain = encode(update)
        with_wire = encode(update, {'wire': wire}) if wire else plain
        first = encode(self._feed.everything(now), self.commands.everything() if self.commands
                       else None) if any(page.fresh for page in self._pages) else ''
        for page in list(self._pages):
            page.send(update['now'], first if page.fresh
                      else with_wire if page.looks_at_wire else plain)


class Server(tornado.httpserver.HTTPServer):
    """Has only so many connections; another one takes the place of the oldest that is no page."""

    hub: Hub
    _open: List[Any] = []

    def handle_stream(self, stream: Any, address: Any) -> None:
        self._open = [each for each in self._open if not each.closed()] + [stream]
        if len(self._open) > _MOST_CONNECTIONS:
            pages = self.hub.streams()
            next(each for each in self._open if each not in pages).close()
        super().handle_stream(stream, address)


def own_names() -> List[str]:
    """What this machine is called."""
    name = socket.gethostname()
    return [name, name.split('.')[0] + '.local', socket.getfqdn()]


def listen(port: int, bind: str) -> List[socket.socket]:
    """The sockets; OSError where there is none to be had."""
    return tornado.netutil.bind_sockets(port, bind, reuse_port=False)


def serve(sockets: List[socket.socket], hub: Hub, guard: Guard) -> tornado.httpserver.HTTPServer:
    """Serve the page on these."""
    logging.getLogger('tornado.access').disabled = True     # the address may hold the token
    settings: Dict[str, Any] = {
        'guard': guard, 'log': hub.log, 'websocket_max_message_size': LONGEST,
        # Cookies know no port: two panels on one machine keep theirs apart by the name.
        'cookie': f'panel_{sockets[0].getsockname()[1]}',
        'log_function': lambda _handler: None}
    application = tornado.web.Application([
        (r'/socket', Session, {'hub': hub}),
        (r'/(.*)', Files, {'path': str(WEB), 'default_filename': 'index.html'}),
    ], **settings)
    server = Server(
        application, max_header_size=_HEADERS, max_body_size=LONGEST, max_buffer_size=1 << 20,
        idle_connection_timeout=60)
    server.hub = hub
    server.add_sockets(sockets)
    return server
