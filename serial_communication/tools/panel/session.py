"""One browser's connection, and all that is said over it.

Every message is one JSON object, strictly: no NaN, no Infinity, no number beyond a double. Times
are seconds of this machine's monotonic clock.

From the server, 25 times a second, so that its silence is a sign; all but `now` and `trouble`
only where there is news:

    now         when this was sent
    trouble     why nothing new can come from the bridge, in words; '' while it talks
    node        (first message) the bridge's name
    boards      {link: {title, longest_gap}}: of each board that is known here, what it is, and
                the seconds without a heartbeat after which it stops its motor (null: it has none)
    known       {topic: {type, links, own}}: all that the bridge publishes; `own` is no topic that
                every bridge has
    topics      {topic: {rows, words, limit, fields}}: rows of [time, value …]; `limit` is the age
                above which the value is stale (null: never); `fields` (where changed) says of
                each value [name, unit, digits, low, high]; NaN and infinities come as text
    links       {link: {at, level, summary, values, errors}}: what /diagnostics says; `errors`
                are rows of [time, {cause: how many more}]
    log         [[time, level, text]]: what the bridge and its boards said
    wire        {frames, left_out}: see wire.py; only while this page looks at the wire
    controls    (first message, with --control) the services and their fields
    calls       [{number, key, name, arguments, began, outcome, words, took}], without the last
                three while it is under way; of every browser
    drive       {held, words}
    refused     {key, words}: what this page asked for is not done

From the page, any number of keys in one message:

    seen        the `now` of the latest message that it has taken; answers every one, and stands
                beside `call` and `led`, too: one that has been kept back for seconds is refused
    watch       [topic]: what it shows; with serial_msg, the wire
    call        {key, name, arguments}: a service
    led         {key, text}
    drive       {key, hold, seen, speed, steering}: ten times a second and more while the pad is
                held; `hold` counts presses
    release     {hold}
"""
import asyncio
import json
import math
import time
from collections import deque
from typing import Any, Deque, Dict, Optional

from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ..watch.topics import SERIAL_MSG
from .dead_man import Refused
from .pages import Guarded

LONGEST = 4096        # bytes of a message from a page
_UNSEEN = 125         # updates, 5 s of them, that a page may not have taken before it is dropped
_MOST_WAITING = 2 << 20    # bytes that may wait for a page; the first update has the history
_RATE = 120.0         # frames a second that a page may send; it sends 25, and 20 as it drives
_BURST = 240.0
_FAREWELL_RATE = 10.0      # of those a dropped page, whose answer to the close is waited for
_MOST_TOPICS = 200    # that a page may ask for


class Session(Guarded, WebSocketHandler):
    """A page that is open."""

    def initialize(self, hub: Any) -> None:
        self._hub = hub
        self.fresh = True          # nothing has been sent yet
        self.topics = frozenset()
        self.stream: Any = None    # once it is open
        self._dropped = False
        self._unseen: Deque[float] = deque()
        self._unsent: Deque[int] = deque()     # sizes of what the system has not taken yet
        self._credit = _BURST
        self._credit_at = time.monotonic()

    def check_origin(self, origin: str) -> bool:
        return True     # Guarded has looked at it

    async def prepare(self) -> None:
        """Refuse before the connection becomes a WebSocket."""
        if not self.refuse(self.hub_guard.refuse_origin(self.request.headers.get('Origin'),
                                                        self.request.host)):
            await super().prepare()
        if not self._finished and self._hub.full():
            self.refuse('too many browsers look already', 503)

    @property
    def looks_at_wire(self) -> bool:
        """Whether it shows the frames of serial_msg."""
        return SERIAL_MSG in self.topics

    def get_websocket_protocol(self) -> Any:
        """tornado's, with every frame counted: it tells of no fragment, and answers each ping."""
        protocol = super().get_websocket_protocol()
        if protocol is not None:
            receive = protocol._receive_frame

            async def receive_and_count() -> None:
                if self._dropped:
                    await asyncio.sleep(1 / _FAREWELL_RATE)
                elif not self._may_speak():
                    self.drop('it says too much')
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
        """Send an update; drop the page if it does not take them, whatever it says to have seen."""
        if max(len(self._unseen), len(self._unsent)) >= _UNSEEN:
            self.drop('it does not take what is sent to it')
            return
        self._unseen.append(now)
        self.fresh = False
        self._write(text)

    def drop(self, why: str) -> None:
        """End the connection, and say so once."""
        self._dropped = True
        self._hub.log.warn(why, f'dropped a page at {self.request.remote_ip}: {why}')
        self.close(1008, why)
        self._hub.remove(self)

    def _write(self, text: str) -> None:
        if sum(self._unsent) > _MOST_WAITING:
            self.drop('it does not take what is sent to it')
            return
        try:
            written = self.write_message(text)
        except WebSocketClosedError:
            self._hub.remove(self)
            return
        self._unsent.append(len(text))
        written.add_done_callback(self._written)

    def _written(self, future: Any) -> None:
        """The oldest has been taken; a page that went meanwhile is no fault to be logged."""
        self._unsent.popleft()
        if not future.cancelled():
            future.exception()

    # -- from the page -------------------------------------------------------------------------

    def on_message(self, message: Any) -> None:
        if self._dropped:
            return
        try:
            self._take(decode(message))
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError,
                ValueError):
            self.drop('it says what no page says')

    def _may_speak(self) -> bool:
        now = time.monotonic()
        self._credit = min(_BURST, self._credit + _RATE * (now - self._credit_at)) - 1
        self._credit_at = now
        return self._credit > 0

    def _take(self, said: Dict[str, Any]) -> None:
        if 'seen' in said:
            while self._unseen and self._unseen[0] <= said['seen']:
                self._unseen.popleft()
        if 'watch' in said:
            self.topics = frozenset(str(name) for name in said['watch'][:_MOST_TOPICS])
            self._hub.watch()
        for name in ('call', 'led', 'drive', 'release'):
            if name in said:
                self._command(name, said[name], float(said.get('seen', 0)))

    def _command(self, name: str, what: Dict[str, Any], seen: float) -> None:
        commands = self._hub.commands
        key = str(what.get('key', ''))[:40]
        try:
            if commands is None:
                raise Refused('this panel only looks; start it with --control')
            if name == 'call':
                commands.call(self, key, seen, str(what['name']), dict(what['arguments']))
            elif name == 'led':
                commands.led(seen, str(what['text']))
            elif name == 'drive':
                commands.drive(self, int(what['hold']), float(what['seen']),
                               int(what['speed']), int(what['steering']))
            else:
                commands.release(self, int(what['hold']))
        except Refused as refused:
            self._hub.log.warn(name, f'{name} of a page at {self.request.remote_ip} refused: '
                                     f'{refused}')
            self._write(encode({'now': time.monotonic(),
                                'refused': {'key': key, 'words': str(refused)}}))


def decode(message: Any) -> Dict[str, Any]:
    """A page's message; ValueError or TypeError where it is none, or not strictly JSON."""
    return dict(json.loads(message, parse_float=_finite, parse_constant=_finite))


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f'{text} is no number of JSON')
    return number


def encode(update: Dict[str, Any], more: Optional[Dict[str, Any]] = None) -> str:
    """As text; NaN, which JSON has not, would be a fault of ours."""
    return json.dumps({**update, **more} if more else update, allow_nan=False,
                      separators=(',', ':'))
