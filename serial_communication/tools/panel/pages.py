"""The page's files over HTTP, and the checks that every request has to pass first.

Everybody may read the files, which are the same for every robot. What they show comes over the
connection (session.py), which needs the token.
"""
from pathlib import Path
from typing import Any, Optional

from tornado.web import RequestHandler, StaticFileHandler

from .guard import Entrance, Guard

WEB = Path(__file__).resolve().parent / 'web'
KEY_HEADER = 'X-Key'
_PERMISSIONS = ', '.join(f'{feature}=()' for feature in (
    'accelerometer', 'camera', 'display-capture', 'fullscreen', 'geolocation',
    'gyroscope', 'hid', 'magnetometer', 'microphone', 'midi', 'payment', 'serial', 'usb'))
_NEEDS_TOKEN = '; open the address that the panel printed'


class GuardedHandler(RequestHandler):
    """A handler that answers only the requests that the guard in the settings allows."""

    @property
    def guard(self) -> Guard:
        """The guard of the application."""
        return self.settings['guard']

    @property
    def entrance(self) -> Entrance:
        """The entrance of the application."""
        return self.settings['entrance']

    async def prepare(self) -> None:
        """Check Host and Origin before the request is answered."""
        request = self.request
        origin = request.headers.get('Origin')
        if not self.refuse('host', self.guard.check_host(request.host)) and origin is not None:
            self.refuse('origin', self.guard.check_origin(origin, request.host))

    def refuse(self, cause: str, reason: str, status: int = 403) -> bool:
        """Refuse the request with this HTTP status, unless the reason is empty.

        Args:
            cause: the log has at most one line for each cause in 10 s.

        Returns:
            Whether there was a reason.
        """
        if not reason or self._finished:
            return bool(reason)
        self.settings['log'].warn(
            cause, f'refused a request from {self.request.remote_ip}: {reason}')
        self.set_status(status)
        self.set_header('Content-Type', 'text/plain; charset=utf-8')
        self.finish(reason)
        return True

    def refuse_without_key(self, key: Optional[str]) -> None:
        """Refuse the request unless this is the token or none is needed."""
        reason = self.entrance.check(key)
        self.refuse('token', reason and reason + _NEEDS_TOKEN, 401)

    def set_default_headers(self) -> None:
        """Allow no foreign or inline content, no embedding in a frame, and no Referer header."""
        host = self.request.host if not self.guard.check_host(self.request.host) else ''
        sockets = f'ws://{host} wss://{host}' if host.isprintable() and ' ' not in host else ''
        for name, value in (
                ('Content-Security-Policy',
                 "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
                 f"connect-src 'self' {sockets}; base-uri 'none'; form-action 'none'; "
                 "frame-ancestors 'none'; require-trusted-types-for 'script'; "
                 "trusted-types 'none'"),
                ('X-Content-Type-Options', 'nosniff'), ('X-Frame-Options', 'DENY'),
                ('Referrer-Policy', 'no-referrer'), ('Permissions-Policy', _PERMISSIONS),
                ('Cross-Origin-Opener-Policy', 'same-origin'),
                ('Cross-Origin-Resource-Policy', 'same-origin'),
                ('Cache-Control', 'no-cache'), ('Server', 'panel')):
            self.set_header(name, value)

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        """Log without the requested address, which may contain the token."""
        self.settings['log'].error('fault', f'a request from {self.request.remote_ip} failed: '
                                            f'{value!r}'.split('\n')[0])


class KeyHandler(GuardedHandler):
    """Checks the token of an address (POST), and says whether a page may connect (GET)."""

    def initialize(self, hub: Any) -> None:
        self._hub = hub

    async def prepare(self) -> None:
        """Check Host and Origin; a page of another site must not send tokens."""
        if self.request.method == 'POST':
            self.refuse('origin', self.guard.check_origin(self.request.headers.get('Origin'),
                                                          self.request.host))
        await super().prepare()

    def set_default_headers(self) -> None:
        """Set the headers of every answer, but let nobody store this one."""
        super().set_default_headers()
        self.set_header('Cache-Control', 'no-store')

    def post(self) -> None:
        """Answer with the token in the body, if it is right."""
        token = self.request.body.decode(errors='replace')
        self.refuse_without_key(token)
        if not self._finished:
            self.finish(token)

    def get(self) -> None:
        """Answer with the reason why a page with this key cannot connect; empty if it can."""
        self.refuse_without_key(self.request.headers.get(KEY_HEADER))
        self.refuse('pages', self._hub.check_room(), 503)
        if not self._finished:
            self.finish()


class FileHandler(GuardedHandler, StaticFileHandler):
    """Serves the folder web/."""

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        """Log nothing: a request for a missing file is not a fault of the panel."""
