"""The connection of one page, and the messages on it.

Every message is one JSON object in strict JSON: no NaN, no Infinity, no number beyond a double.
Times are seconds of this machine's monotonic clock.

From the server, 25 times a second, so that the page notices a lost connection. `now` and `trouble`
are in every message, the other keys only if they have changed:

    now         when this was sent
    trouble     why nothing new can be received from the bridge; '' if it can
    node        (first message) the bridge's name
    boards      {link: {title, longest_gap}} of each known board: what it is, and the seconds
                without a heartbeat after which it stops its motor (null: it has no heartbeat)
    known       {topic: {type, links, card}}: everything that the bridge publishes; `card` is the
                title of its card, '' for one of its own, null for none
    topics      {topic: {samples, words, limit, fields}}: a sample is [time, value …]; `limit` is
                the age in s above which the value is stale (null: never); `fields` (if changed) has
                [name, unit, digits, low, high] for each value; NaN and infinities are strings
    links       {link: {at, level, summary, values, errors}}: its status in /diagnostics; an entry
                of `errors` is [time, {cause: increase}]
    log         [[time, level, text]]: log lines of the bridge
    wire        {frames, left_out}: see wire.py; only while this page shows the wire
    controls    (first message, with --control) {services: {name: {link, fields, title, confirm}},
                messages: {name: {link, fields}}}; a field is {name, kind, whole, unit, low, high,
                preset, choices}, a choice [label, value]; the last two only if there are any
    calls       [{number, key, name, arguments, began, outcome, words, took, reply}] of every page,
                calls and messages; without the last four while the call is under way. `reply` (of
                a call) has [field, value as text] of the response
    drives      whether a page drives
    refused     {key, words}: why a command of this page was not executed

From the page, any of these keys in one message:

    seen        the `now` of the latest message received; acknowledges it and all before it.
                `call`, `send` and `led` are refused if it is older than 2 s
    watch       [topic]: the topics that the page shows; serial_msg: the wire
    call        {key, name, arguments}: call a service. This and all others but `stop` and `release`
                are refused in the first second of a connection: the page has just appeared, and
                the press may have been meant for what was there before
    send        {key, name, values}: send a custom command
    led         {key, text}
    stop        {key}: end any page's driving, and call ~stop with true. `call` ends it, with false
    drive       {key, hold, seen, speed, steering}: at least ten times a second while the pad is
                held; `hold` counts presses
    release     {hold}
"""
import asyncio
import json
import math
import time
from collections import deque
from typing import Any, Deque, Dict, FrozenSet, List, Optional

from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ..watch.topics import SERIAL_MSG
from .dead_man import CommandRefused
from .pages import GuardedHandler

MAX_MESSAGE = 1 << 15      # bytes of a message from a page: the names of the topics it watches
_MAX_UNACKNOWLEDGED = 125  # updates, 5 s of them, after which the page is dropped
_MAX_WAITING = 2 << 20     # bytes that may wait for a page; the first update has the history
_RATE = 120.0         # frames a second that a page may send; it sends 25, and 45 as it drives
_SETTLING = 1.0       # s of a connection in which no command moves anything
_BURST = 240.0        # frames that it may send at once
_DROPPED_RATE = 10.0  # frames a second read from a dropped page, until it answers the close frame
_MAX_TOPICS = 1000    # that a page may watch
_PROTOCOL = 'panel'
_NOT_READING = 'it does not read what is sent to it'


class Session(GuardedHandler, WebSocketHandler):
    """The connection of a page that is open."""

    def initialize(self, hub: Any) -> None:
        self._hub = hub
        self.is_new = True         # no update has been sent yet
        self.topics: FrozenSet[str] = frozenset()
        self.stream: Any = None    # once it is open
        self._dropped = False
        self._unacknowledged: Deque[float] = deque()    # `now` of each update
        self._unsent: Deque[int] = deque()     # sizes of the updates that still wait here
        self._credit = _BURST
        self._credit_at = self._opened_at = time.monotonic()

    def check_origin(self, origin: str) -> bool:
        return True     # `prepare` has checked it

    async def prepare(self) -> None:
        """Refuse the request before the connection becomes a WebSocket."""
        if not self.refuse('origin', self.guard.check_origin(self.request.headers.get('Origin'),
                                                             self.request.host)):
            await super().prepare()
        offered = self.request.headers.get('Sec-WebSocket-Protocol', '').split(',')
        self.refuse_without_key(next((each.strip() for each in offered
                                      if each.strip() not in ('', _PROTOCOL)), None))
        self.refuse('pages', self._hub.check_room(), 503)

    def select_subprotocol(self, subprotocols: List[str]) -> Optional[str]:
        """A page may offer its key as a second protocol: it can set no other header."""
        return _PROTOCOL if _PROTOCOL in subprotocols else None

    @property
    def shows_wire(self) -> bool:
        """Whether the page shows the frames of serial_msg."""
        return SERIAL_MSG in self.topics

    def get_websocket_protocol(self) -> Any:
        """Return tornado's protocol, changed to count every frame.

        tornado itself reports no fragments, and answers each ping.
        """
        protocol = super().get_websocket_protocol()
        if protocol is not None:
            receive = protocol._receive_frame

            async def receive_and_count() -> None:
                if self._dropped:
                    await asyncio.sleep(1 / _DROPPED_RATE)
                elif not self._take_credit():
                    self.drop(f'it sends more than {_RATE:g} frames a second')
                await receive()
            protocol._receive_frame = receive_and_count
        return protocol

    def open(self) -> None:     # pylint: disable=arguments-differ
        self.stream = self.ws_connection.stream
        self.set_nodelay(True)
        self._hub.add(self)

    def on_close(self) -> None:
        self._hub.remove(self)

    def send(self, now: float, text: str) -> None:
        """Send an update. Drop the page if it does not read them, whatever it acknowledges."""
        if max(len(self._unacknowledged), len(self._unsent)) >= _MAX_UNACKNOWLEDGED:
            self.drop(_NOT_READING)
            return
        self._unacknowledged.append(now)
        self.is_new = False
        self._write(text)

    def drop(self, reason: str) -> None:
        """Close the connection and log the reason; the page gets it, too."""
        self._dropped = True
        self._hub.log.warn(reason, f'dropped a page at {self.request.remote_ip}: {reason}')
        self.close(1008, reason)
        self._hub.remove(self)

    def _write(self, text: str) -> None:
        if sum(self._unsent) > _MAX_WAITING:
            self.drop(_NOT_READING)
            return
        try:
            written = self.write_message(text)
        except WebSocketClosedError:
            self._hub.remove(self)
            return
        self._unsent.append(len(text))
        written.add_done_callback(self._written)

    def _written(self, future: Any) -> None:
        """The system has taken the oldest update, or the page is closed, which is not an error."""
        self._unsent.popleft()
        if not future.cancelled():
            future.exception()      # mark it as retrieved, or asyncio logs it

    # -- from the page -------------------------------------------------------------------------

    def on_message(self, message: Any) -> None:
        if self._dropped:
            return
        try:
            self._handle(decode(message))
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError,
                ValueError):
            self.drop('it sent an invalid message')

    def _take_credit(self) -> bool:
        """Count a frame; return whether the page is within its rate."""
        now = time.monotonic()
        self._credit = min(_BURST, self._credit + _RATE * (now - self._credit_at)) - 1
        self._credit_at = now
        return self._credit > 0

    def _handle(self, message: Dict[str, Any]) -> None:
        if 'seen' in message:
            while self._unacknowledged and self._unacknowledged[0] <= message['seen']:
                self._unacknowledged.popleft()
        if 'watch' in message:
            self.topics = frozenset(str(name) for name in message['watch'][:_MAX_TOPICS])
            self._hub.watch()
        for name in ('call', 'send', 'led', 'stop', 'drive', 'release'):
            if name in message:
                self._command(name, message[name], float(message.get('seen', 0)))

    def _command(self, name: str, values: Dict[str, Any], seen: float) -> None:
        commands = self._hub.commands
        key = str(values.get('key', ''))[:40]
        try:
            if commands is None:
                raise CommandRefused('this panel is read-only; start it with --control')
            if name not in ('stop', 'release') and \
                    time.monotonic() - self._opened_at < _SETTLING:
                raise CommandRefused('nothing was sent: the page has just appeared; press again')
            if name == 'call':
                commands.call(self, key, seen, str(values['name']), dict(values['arguments']))
            elif name == 'send':
                commands.send(self, key, seen, str(values['name']), dict(values['values']))
            elif name == 'led':
                commands.led(key, seen, str(values['text']))
            elif name == 'stop':
                commands.press_stop(key)
            elif name == 'drive':
                commands.drive(self, int(values['hold']), float(values['seen']),
                               int(values['speed']), int(values['steering']))
            else:
                commands.release(self, int(values['hold']))
        except CommandRefused as refused:
            self._hub.log.warn(name, f'{name} of a page at {self.request.remote_ip} refused: '
                                     f'{refused}')
            self._write(encode({'now': round(time.monotonic(), 4),
                                'refused': {'key': key, 'words': str(refused)}}))


def decode(message: Any) -> Dict[str, Any]:
    """Decode a page's message.

    Raises:
        TypeError, ValueError, RecursionError: it is not an object in strict JSON.
    """
    return dict(json.loads(message, parse_float=_finite, parse_constant=_finite))


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f'{text} is not a number in JSON')
    return number


def encode(update: Dict[str, Any], more: Optional[Dict[str, Any]] = None) -> str:
    """Encode an update; ValueError on NaN, which strict JSON does not have."""
    return json.dumps({**update, **more} if more else update, allow_nan=False,
                      separators=(',', ':'))
