"""Who may open the page: checks a request's Host, Origin and token. Pure."""
import hmac
import ipaddress
from typing import Iterable, Optional
from urllib.parse import urlsplit

MIN_TOKEN_LENGTH = 12     # characters; a token can be guessed over the network


def _host_name(netloc: str) -> str:
    """The name or address in HOST[:PORT], in lower case; empty if invalid."""
    try:
        return (urlsplit('//' + netloc).hostname or '').rstrip('.')
    except ValueError:
        return ''


def is_address(name: str) -> bool:
    """Whether this is an IP address, not a name."""
    try:
        ipaddress.ip_address(name.split('%')[0])
    except ValueError:
        return False
    return True


def is_loopback(name: str) -> bool:
    """Whether only this machine can connect to what listens on this name or address."""
    return name == 'localhost' or is_address(name) and ipaddress.ip_address(name).is_loopback


class Guard:
    """Checks requests before they are answered.

    Each check returns why the request is refused, or an empty string if it is allowed.

    Args:
        names: of this machine. A page of another site can reach it only by a name of its own that
            resolves to this machine's address (DNS rebinding), not by an address or these names.
        token: that every request has to carry, in the address or as a cookie; None: no token.
    """

    def __init__(self, names: Iterable[str], token: Optional[str]) -> None:
        self._names = {'localhost', *(name.lower() for name in names)}
        self._token = token

    def check_host(self, host: str) -> str:
        """Check the Host header."""
        name = _host_name(host)
        if name in self._names or is_address(name):
            return ''
        return f'Host {host[:80]!r} is not a name of this machine'

    @staticmethod
    def check_origin(origin: Optional[str], host: str) -> str:
        """Check that the connection comes from a page of this host; None: no Origin header."""
        if origin is None:
            return 'it has no Origin header, which every browser sends'
        try:
            same = urlsplit(origin).netloc.lower() == host.lower()
        except ValueError:
            same = False
        return '' if same else f'it comes from a page of {origin[:80]!r}'

    def check_token(self, *tokens: Optional[str]) -> str:
        """Check that one of these tokens is valid."""
        if self._token is None:
            return ''
        valid = self._token.encode()
        # The list compares every token, each in constant time, so that the time reveals nothing.
        if any([hmac.compare_digest(each.encode(errors='replace'), valid)
                for each in tokens if each]):
            return ''
        return 'the token is wrong' if any(tokens) else 'it has no token'
