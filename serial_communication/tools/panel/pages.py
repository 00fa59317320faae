"""The page's files over HTTP, and what every request has to pass first."""
from pathlib import Path
from typing import Any

from tornado.web import RequestHandler, StaticFileHandler

from .guard import Guard

WEB = Path(__file__).resolve().parent / 'web'
TOKEN = 'token'
_REFUSED = ('This page is not shown: {why}.\n\n'
            'Open the address that the panel printed as it started, with its token.\n')


class Guarded(RequestHandler):
    """A handler that answers only whom the guard lets in; the application's settings have it."""

    @property
    def hub_guard(self) -> Guard:
        """Who decides."""
        return self.settings['guard']

    async def prepare(self) -> None:
        """Look at Host, Origin and token, before anything is told."""
        request = self.request
        origin = request.headers.get('Origin')
        shown = (self.get_query_argument(TOKEN, None), self.get_cookie(self.settings['cookie']))
        if self.refuse(self.hub_guard.refuse_host(request.host)) or origin is not None \
                and self.refuse(self.hub_guard.refuse_origin(origin, request.host)):
            return
        if not self.refuse(self.hub_guard.refuse_token(*shown), 401) and shown[0]:
            self.set_cookie(self.settings['cookie'], shown[0], httponly=True, samesite='Strict')

    def refuse(self, why: str, status: int = 403) -> bool:
        """Answer that it is refused and why, if there is a reason; whether there was."""
        if not why or self._finished:
            return bool(why)
        self.settings['log'].warn(
            why.split(' ')[0], f'refused a request of {self.request.remote_ip}: {why}')
        self.set_status(status)
        self.set_header('Content-Type', 'text/plain; charset=utf-8')
        self.finish(_REFUSED.format(why=why))
        return True

    def set_default_headers(self) -> None:
        """Nothing from elsewhere, nothing inline, in nobody's frame, in no one's log."""
        host = self.request.host if not self.hub_guard.refuse_host(self.request.host) else ''
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
        """Without the address, which may hold the token."""
        self.settings['log'].error('fault', f'a request of {self.request.remote_ip} failed: '
                                            f'{value!r}'.split('\n')[0])


class Files(Guarded, StaticFileHandler):
    """The folder web/."""

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        """A file that is not there is nobody's fault."""
