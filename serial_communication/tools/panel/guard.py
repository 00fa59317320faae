"""Who may open the page: checks a request's Host and Origin, and its token. Pure."""
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
    """Checks from where a request comes, before it is answered.

    Each check returns why the request is refused, or an empty string if it is allowed.

    Args:
        bind: the address or name that the panel listens on.
        names: of this machine. A page of another site can reach it only by a name of its own that
            resolves to this machine's address (DNS rebinding), not by an address or these names.
            They are not used on loopback, where a name of this machine leads to a proxy or tunnel
            that others reach.
    """

    def __init__(self, bind: str, names: Iterable[str]) -> None:
        self._loopback_only = is_loopback(bind)
        self._names = {bind.lower(), *(name.lower() for name in names)}

    def check_host(self, host: str) -> str:
        """Check the Host header."""
        name = _host_name(host)
        if is_loopback(name) or not self._loopback_only and (
                name in self._names or is_address(name)):
            return ''
        return f'Host {host[:80]!r} is not a name of this machine' + (
            ' on loopback' if self._loopback_only else '')

    @staticmethod
    def check_origin(origin: Optional[str], host: str) -> str:
        """Check that the request comes from a page of this host; None: no Origin header."""
        if origin is None:
            return 'it has no Origin header, which every browser sends'
        try:
            same = urlsplit(origin).netloc.lower() == host.lower()
        except ValueError:
            same = False
        return '' if same else f'it comes from a page of {origin[:80]!r}'


class Entrance:
    """Knows the token of the printed address. A browser keeps it in its storage for this host and
    port, not in a cookie, which it would send to every port of the host.

    Args:
        token: None: there is none, and everybody who reaches the page may use it.
    """

    def __init__(self, token: Optional[str]) -> None:
        self.token = token

    def check(self, given: Optional[str]) -> str:
        """Why a request with this token is refused; empty if it is allowed."""
        # In constant time, so that the time reveals nothing.
        if self.token is None or given and hmac.compare_digest(
                given.encode(errors='replace'), self.token.encode()):
            return ''
        return 'its token is wrong' if given else 'it has no token'
