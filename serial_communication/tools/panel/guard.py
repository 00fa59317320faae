"""Who may open the page: checks a request's Host and Origin, tokens and keys. Pure."""
import hmac
import ipaddress
import secrets
from collections import deque
from typing import Callable, Deque, Iterable, Optional
from urllib.parse import urlsplit

MIN_TOKEN_LENGTH = 12     # characters; a token can be guessed over the network
_PAUSE = 2.0              # s between two guesses of a token of the user's own, in the long run
_GUESSES = 100            # that may come at once
_MAX_KEYS = 100           # of browsers; a further one makes the oldest invalid


class WrongToken(Exception):
    """The token is not exchanged for a key; the text says why."""


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
    """Exchanges the token in the printed address for a key, which one browser keeps.

    A key is in the browser's storage for this host and port, not in a cookie: a browser sends
    cookies to every port of a host.

    Args:
        needed: False: there is no token, and everybody who reaches the page may use it.
        given: a token that may be exchanged any number of times; None: each one is new, and is
            exchanged once. A new one cannot be guessed. A given one may be a word: so, after
            100 wrong tokens at once from all addresses together, one in 2 s is compared.
    """

    def __init__(self, needed: bool, given: Optional[str] = None) -> None:
        self._needed = needed
        self._given = given
        self.token: Optional[str] = (given or secrets.token_urlsafe(16)) if needed else None
        self.on_used: Callable[[], None] = lambda: None    # a token has been replaced by a new one
        self._keys: Deque[str] = deque(maxlen=_MAX_KEYS)
        self._guessed_until = 0.0   # the time of the latest guess if there were one every _PAUSE

    def exchange(self, token: str, now: float) -> str:
        """Return a new key for this token.

        Raises:
            WrongToken: there is no key, and the text says why.
        """
        if self._given and self._guessed_until - now >= _GUESSES * _PAUSE:
            raise WrongToken(f'somebody sends wrong tokens; one in {_PAUSE:g} s is compared: '
                             'try again')
        if not self.token or not _same(token, self.token):
            self._guessed_until = max(self._guessed_until, now) + _PAUSE
            raise WrongToken('the token is wrong, or has been used already')
        key = secrets.token_urlsafe(16)
        self._keys.append(key)
        if not self._given:
            self.token = secrets.token_urlsafe(16)
            self.on_used()
        return key

    def check_key(self, key: Optional[str]) -> str:
        """Why a request with this key is refused; empty if it is allowed."""
        # The list compares every key, each in constant time, so that the time reveals nothing.
        if not self._needed or key and any([_same(key, each) for each in self._keys]):
            return ''
        return 'its key is not valid any more' if key else 'it has no token'


def _same(given: str, valid: str) -> bool:
    return hmac.compare_digest(given.encode(errors='replace'), valid.encode())
