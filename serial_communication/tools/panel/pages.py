"""The page's files over HTTP, and the checks that every request has to pass first."""
from pathlib import Path
from typing import Any

from tornado.web import RequestHandler, StaticFileHandler

from .guard import Guard

WEB = Path(__file__).resolve().parent / 'web'
TOKEN = 'token'
_REFUSAL = ('This page is not shown: {reason}.\n\n'
            'Open the address that the panel printed when it started, with its token.\n')


class GuardedHandler(RequestHandler):
    """A handler that answers only the requests that the guard in the settings allows."""

    @property
    def guard(self) -> Guard:
        """The guard of the application."""
        return self.settings['guard']

    async def prepare(self) -> None:
        """Check Host, Origin and token before the request is answered."""
        request = self.request
        origin = request.headers.get('Origin')
        tokens = (self.get_query_argument(TOKEN, None), self.get_cookie(self.settings['cookie']))
        if self.refuse('host', self.guard.check_host(request.host)) or origin is not None \
                and self.refuse('origin', self.guard.check_origin(origin, request.host)):
            return
        if not self.refuse('token', self.guard.check_token(*tokens), 401) and tokens[0]:
            self.set_cookie(self.settings['cookie'], tokens[0], httponly=True, samesite='Strict')

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
        self.finish(_REFUSAL.format(reason=reason))
        return True

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
                ('Referrer-Policy', 'no-referrer'),
                ('Cross-Origin-Opener-Policy', 'same-origin'),
                ('Cross-Origin-Resource-Policy', 'same-origin'),
                ('Cache-Control', 'no-cache'), ('Server', 'panel')):
            self.set_header(name, value)

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        """Log without the requested address, which may contain the token."""
        self.settings['log'].error('fault', f'a request from {self.request.remote_ip} failed: '
                                            f'{value!r}'.split('\n')[0])


class FileHandler(GuardedHandler, StaticFileHandler):
    """Serves the folder web/."""

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        """Log nothing: a request for a missing file is not a fault of the panel."""
