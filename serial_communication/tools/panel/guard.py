"""Who may look: the checks of a request's Host, Origin and token. Pure."""
import hmac
import ipaddress
from typing import Iterable, Optional
from urllib.parse import urlsplit

SHORTEST_TOKEN = 12     # characters; a token can be tried over the network


def _host_name(netloc: str) -> str:
    """The name or address of HOST[:PORT], in lower case; empty where it is neither."""
    try:
        return (urlsplit('//' + netloc).hostname or '').rstrip('.')
    except ValueError:
        return ''


def is_address(name: str) -> bool:
    """Whether this is an IP address and no name."""
    try:
        ipaddress.ip_address(name.split('%')[0])
    except ValueError:
        return False
    return True


def is_loopback(name: str) -> bool:
    """Whether only this machine reaches what is bound to this name or address."""
    return name == 'localhost' or is_address(name) and ipaddress.ip_address(name).is_loopback


class Guard:
    """What a request has to show before anything is told.

    Args:
        names: of this machine. A page of another site reaches us by a name of its own that
            resolves to our address (DNS rebinding), never by an address or by one of these.
        token: that every request has to carry, in the address or as a cookie; None: no token.
    """

    def __init__(self, names: Iterable[str], token: Optional[str]) -> None:
        self._names = {'localhost', *(name.lower() for name in names)}
        self._token = token

    def refuse_host(self, host: str) -> str:
        """Why this Host header is refused; empty if it is not."""
        name = _host_name(host)
        if name in self._names or is_address(name):
            return ''
        return f'the Host {host[:80]!r} is no name of this machine'

    @staticmethod
    def refuse_origin(origin: Optional[str], host: str) -> str:
        """Why a connection from a page of `origin` is refused; empty if it is not."""
        if origin is None:
            return 'it names no Origin, as every browser does'
        try:
            same = urlsplit(origin).netloc.lower() == host.lower()
        except ValueError:
            same = False
        return '' if same else f'it comes from a page of {origin[:80]!r}'

    def refuse_token(self, *shown: Optional[str]) -> str:
        """Why none of these tokens lets in; empty if one does."""
        if self._token is None:
            return ''
        right = self._token.encode()
        # Each is compared, in constant time, so that the time tells nothing.
        if any([hmac.compare_digest(each.encode(errors='replace'), right)
                for each in shown if each]):
            return ''
        return 'the token is wrong' if any(shown) else 'it shows no token'
