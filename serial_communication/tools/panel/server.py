"""Who may open the page: Host and Origin of each request, and the token.

Everybody may read the files, which are the same for every robot. What they show comes over the
connection (pages.py), which needs the token: once, then a signed cookie.
"""
import hmac
import ipaddress
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any, Collection, Optional
from urllib.parse import urlsplit

import tornado.web

_WEB = Path(__file__).resolve().parent / 'web'
_MAX_MESSAGE = 1 << 15   # bytes of a message from a page
_PING = 3.0              # s between two pings, which find connections that are dead
_POLICY = ("default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
           "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
           "require-trusted-types-for 'script'; trusted-types 'none'")
_HEADERS = {'Content-Security-Policy': _POLICY, 'X-Content-Type-Options': 'nosniff',
            'X-Frame-Options': 'DENY', 'Server': 'panel', 'Referrer-Policy': 'no-referrer',
            'Cross-Origin-Opener-Policy': 'same-origin',
            'Cross-Origin-Resource-Policy': 'same-origin', 'Cache-Control': 'no-cache'}


def _as_address(name: str) -> Any:
    """The IP address that this is; None: it is a name."""
    try:
        return ipaddress.ip_address(name.split('%')[0])
    except ValueError:
        return None


def is_loopback(name: str) -> bool:
    """Whether only this machine can connect to what listens on this name or address."""
    return name == 'localhost' or getattr(_as_address(name), 'is_loopback', False)


def own_names(bind: str) -> Collection[str]:
    """The names by which this machine may be asked if the panel listens on this address.

    A page of another site can reach it only by a name of its own that resolves to this machine's
    address (DNS rebinding), not by an address or a name of this machine. On loopback no name
    counts, since it leads to a proxy or tunnel that others reach.
    """
    name = socket.gethostname()
    return () if is_loopback(bind) else {
        each.lower() for each in (bind, name, name.split('.')[0] + '.local', socket.getfqdn())}


def is_own(host: str, names: Collection[str]) -> bool:
    """Whether a request with this Host header may be answered; `names` as `own_names`."""
    with suppress(ValueError):
        name = (urlsplit('//' + host).hostname or '').rstrip('.')
        return is_loopback(name) or bool(names) and (
            name in names or _as_address(name) is not None)
    return False


def is_of(origin: Optional[str], host: str) -> bool:
    """Whether a request with this Origin comes from a page of this host."""
    with suppress(ValueError):
        return origin is not None and urlsplit(origin).netloc.lower() == host.lower()
    return False


class Guarded(tornado.web.RequestHandler):
    """A handler that answers only what comes from a page of this host.

    Every browser sends Origin with a request that may change something; without `needs_origin` it
    may be missing.
    """

    needs_origin = False

    async def prepare(self) -> None:
        """Check Host and Origin before the request is answered."""
        host, origin = self.request.host, self.request.headers.get('Origin')
        if not is_own(host, self.settings['names']):
            self.refuse(403, f'Host {host[:80]!r} is not a name of this machine')
        elif (self.needs_origin or origin is not None) and not is_of(origin, host):
            self.refuse(403, f'it comes from a page of {(origin or "?")[:80]!r}')

    def refuse(self, status: int, reason: str) -> None:
        """Refuse the request with this HTTP status."""
        self.settings['log'].warn(
            'refused', f'refused a request from {self.request.remote_ip}: {reason}')
        self.set_status(status)
        self.set_header('Content-Type', 'text/plain; charset=utf-8')
        self.finish(reason)

    def set_default_headers(self) -> None:
        """Allow no foreign or inline content, and no embedding in a frame."""
        for name, value in _HEADERS.items():
            self.set_header(name, value)


class Token(Guarded):
    """Takes the token of the printed address, and gives a cookie for it."""

    needs_origin = True

    def post(self) -> None:
        """Let a browser in that sends the right token as the body."""
        # In constant time, so that the time reveals nothing.
        if not hmac.compare_digest(self.request.body, self.settings['token'].encode()):
            self.refuse(401, 'its token is wrong')
            return
        self.set_secure_cookie(self.settings['cookie_name'], 'in', expires_days=None,
                               httponly=True, samesite='Strict')


class Files(Guarded, tornado.web.StaticFileHandler):
    """Serves the folder web/."""


def application(page: Any, hub: Any, names: Collection[str], token: str,
                port: int) -> tornado.web.Application:
    """The page, its files, and its connections, which are of the class `page`.

    The port names the cookie, since a browser sends those of all ports of a host; the token signs
    it. `names` as `own_names`.
    """
    return tornado.web.Application(
        [(r'/socket', page, {'hub': hub}), (r'/token', Token),
         (r'/(.*)', Files, {'path': str(_WEB), 'default_filename': 'index.html'})],
        names=names, token=token, cookie_name=f'panel_{port}', cookie_secret=token, log=hub.log,
        websocket_ping_interval=_PING, websocket_max_message_size=_MAX_MESSAGE,
        log_function=lambda _handler: None)
