"""The web server: the pages that are open, and the updates that each is sent."""
import socket
import time
import traceback
from typing import Any, Dict, List, Optional, Set

import tornado.httpserver
import tornado.ioloop
import tornado.web

from ...link.sparing_log import SparingLog
from .commands import Commands
from .feed import Feed
from .guard import Entrance, Guard
from .pages import WEB, FileHandler, KeyHandler
from .session import MAX_MESSAGE, Session, encode

PERIOD = 0.04          # s between two updates
_MAX_PAGES = 16
_MAX_CONNECTIONS = 64      # of pages and all others; a browser has up to 6 while it loads a page
_GRACE = 1.0           # s to keep the subscriptions without a page: the last one may only reload
_MAX_HEADER = 16384    # bytes of a request
_MAX_BODY = 4096       # bytes


class Hub:
    """The pages that are open; the feed and the publishers are active while there is one."""

    def __init__(self, feed: Feed, commands: Optional[Commands], log: SparingLog) -> None:
        self.commands = commands
        self.log = log
        self._feed = feed
        self._pages: Set[Session] = set()
        self._ready = False          # whether rospy can be used
        self._active = False
        self._next_tick: Any = None      # the handle of the next update; None: no updates are sent

    def ros_started(self) -> None:
        """rospy.init_node has returned."""
        self._ready = True
        self._activate()

    def streams(self) -> Set[Any]:
        """The connections of the pages."""
        return {page.stream for page in self._pages}

    def check_room(self) -> str:
        """Why no further page may be opened; empty if one may."""
        return f'{_MAX_PAGES} pages are open, which is the limit' \
            if len(self._pages) >= _MAX_PAGES else ''

    def add(self, page: Session) -> None:
        """Begin to send updates to this page."""
        self._pages.add(page)
        self._activate()
        if self._next_tick is None:
            self._tick_later()

    def remove(self, page: Session) -> None:
        """The page is closed: stop its driving, and send it nothing more."""
        if page not in self._pages:
            return
        self._pages.discard(page)
        if self.commands:
            self.commands.forget(page)
        self.watch()
        if not self._pages:
            tornado.ioloop.IOLoop.current().call_later(_GRACE, self._deactivate)

    def watch(self) -> None:
        """Subscribe to the topics that any page shows."""
        if self._pages:
            self._feed.want(frozenset().union(*(page.topics for page in self._pages)))

    def stop(self) -> bool:
        """Stop the car if a page drives, and send nothing more; return whether one drove."""
        drove = bool(self.commands and self.commands.stop_driving())
        self._pages.clear()
        return drove

    def _activate(self) -> None:
        if self._ready and self._pages and not self._active:
            self._active = True
            self._feed.start()
            if self.commands:
                self.commands.start()

    def _deactivate(self) -> None:
        if self._pages or self._next_tick is None:      # the latter: a page before this one
            return
        tornado.ioloop.IOLoop.current().remove_timeout(self._next_tick)
        self._next_tick = None
        if self._active:
            self._active = False
            self._feed.stop()
            if self.commands:
                self.commands.stop()

    def _tick_later(self) -> None:
        # Not a PeriodicCallback: it stands for as long as the system's clock is set back.
        self._next_tick = tornado.ioloop.IOLoop.current().call_later(PERIOD, self._tick)

    def _tick(self) -> None:
        self._tick_later()
        try:
            self._update()
        except Exception:  # pylint: disable=broad-except
            # The pages must show that the panel has failed.
            self.log.error('fault', traceback.format_exc())
            now = time.monotonic()
            text = encode({'now': round(now, 4), 'trouble': 'the panel has failed; see its log'})
            for page in list(self._pages):
                page.send(now, text)

    def _update(self) -> None:
        now = time.monotonic()
        update, wire = self._feed.changes(now)
        if self.commands:
            update.update(self.commands.changes(self._feed.state))
        plain = encode(update)
        with_wire = encode(update, {'wire': wire}) if wire else plain
        first = encode(self._feed.snapshot(now), self.commands.snapshot() if self.commands
                       else None) if any(page.is_new for page in self._pages) else ''
        for page in list(self._pages):
            page.send(update['now'], first if page.is_new
                      else with_wire if page.shows_wire else plain)


class Server(tornado.httpserver.HTTPServer):
    """Limits the connections: one too many closes the oldest that is not a page's."""

    hub: Hub
    _open: List[Any] = []

    def handle_stream(self, stream: Any, address: Any) -> None:
        self._open = [each for each in self._open if not each.closed()] + [stream]
        if len(self._open) > _MAX_CONNECTIONS:
            pages = self.hub.streams()
            next(each for each in self._open if each not in pages).close()
        super().handle_stream(stream, address)


def host_names() -> List[str]:
    """The names of this machine."""
    name = socket.gethostname()
    return [name, name.split('.')[0] + '.local', socket.getfqdn()]


def serve(sockets: List[socket.socket], hub: Hub, guard: Guard,
          entrance: Entrance) -> tornado.httpserver.HTTPServer:
    """Serve the page on these sockets."""
    settings: Dict[str, Any] = {
        'guard': guard, 'entrance': entrance, 'log': hub.log,
        'websocket_max_message_size': MAX_MESSAGE, 'log_function': lambda _handler: None}
    application = tornado.web.Application([
        (r'/socket', Session, {'hub': hub}), (r'/key', KeyHandler, {'hub': hub}),
        (r'/(.*)', FileHandler, {'path': str(WEB), 'default_filename': 'index.html'}),
    ], **settings)
    server = Server(
        application, max_header_size=_MAX_HEADER, max_body_size=_MAX_BODY,
        max_buffer_size=1 << 20, idle_connection_timeout=60)
    server.hub = hub
    server.add_sockets(sockets)
    return server
