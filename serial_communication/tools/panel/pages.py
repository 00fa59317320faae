"""The pages that are open, and the messages on their connections.

Every message is one JSON object in strict JSON. Times are seconds of this machine's monotonic
clock. From the panel, 20 times a second, but not before the page has acknowledged the one before: a
slow page gets fewer updates, and each has the newest of everything that has changed since:

    now       when this was sent
    wall      what to add to a time for the time of the day, s
    control   (first message) whether the page may command
    state     node; trouble (why nothing new can be received from the bridge); drives (whether a
              page drives); titles {link: what its board is}; forms: see `Form.described`;
              topics {topic: {type, fields, limit}}: a field is [name, unit, digits, low, high],
              `limit` the age in s above which the values are stale (null: never)
    samples   {topic: [time, value of each field]}; a number that is not finite is a string
    links     {link: {at, level, summary, values}}: its status in /diagnostics; null: none yet
    log       {number: [time, level, text]}: lines of the bridge
    frames    {number: frame}: see `feed`; only while this page shows the wire
    calls     {number: {number, key, name, values, began, outcome, words, took, reply}} of every
              page; without the last four while it is under way. `reply` has [field, value as text]
    refused   {key, words}: why a command of this page was not executed (alone in its message)

From the page, any of these in one message:

    seen      the `now` of the latest message received: acknowledges it
    wire      whether it shows the wire
    send      {key, name, values}: call the service of a form, or publish its message
    stop, go  {key}: STOP, and its end
    drive     {hold, values}: at least ten times a second while the pad is held; `hold` counts
              presses, `values` are those of the commands to send, by form and field
    release   {hold}
"""
import asyncio
import json
import math
import time
import traceback
from contextlib import suppress
from typing import Any, Callable, Dict, Optional, Set

from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ...link.sparing_log import SparingLog
from .commands import Commands
from .driving import CommandRefused
from .feed import FRAMES, Feed
from .news import News
from .server import Guarded

_PERIOD = 0.05       # s between two updates
_GRACE = 1.0         # s to keep the subscriptions without a page: the last one may only reload
_NO_TOKEN = 'it has not the token; open the address that the panel printed'
_WRONG = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError


class Hub:
    """The pages that are open; topics are subscribed to while there is one.

    Args:
        commands: None: the pages only look.
    """

    def __init__(self, feed: Feed, commands: Optional[Commands], news: News, log: SparingLog,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self.commands = commands
        self.news = news
        self.log = log
        self.clock = clock
        self.ros_runs = False        # rospy.init_node has returned
        self.pages: Set['Page'] = set()
        self._feed = feed
        self._active_until = 0.0

    async def run(self) -> None:
        """Send updates, for ever."""
        while True:
            await asyncio.sleep(_PERIOD)
            self.tick()

    def tick(self) -> None:
        """Do what is due now, and send an update to each page that has acknowledged the last."""
        now = self.clock()
        try:
            self._update(now)
        except Exception:  # pylint: disable=broad-except
            self.log.error('fault', traceback.format_exc())
            self.news.tell('state', 'trouble', 'the panel has failed; see its log')
        for page in list(self.pages):
            page.update(now)

    def _update(self, now: float) -> None:
        if self.pages:
            self._active_until = now + _GRACE
        active = self.ros_runs and now < self._active_until
        if self.commands:
            self.commands.tick(now, active)
        self._feed.want(active, any(page.shows_wire for page in self.pages), now)
        self._feed.update(now)


class Page(Guarded, WebSocketHandler):
    """The connection of a page."""

    needs_origin = True

    def initialize(self, hub: Hub) -> None:
        self._hub = hub
        self.shows_wire = False
        self._told = 0              # number of the news that it has been told
        self._unseen: Optional[float] = None    # `now` of an update that it has not acknowledged
        self._seen = -math.inf      # … of the latest that it has acknowledged

    def check_origin(self, origin: str) -> bool:
        return True     # `prepare` has checked it

    def open(self, *_arguments: str, **_more: str) -> None:
        """Let the page in, or close the connection with the reason, which a page cannot read from
        a refused request."""
        if self.get_secure_cookie(self.settings['cookie_name']):
            self.set_nodelay(True)
            self._hub.pages.add(self)
        else:
            self.close(1008, _NO_TOKEN)

    def on_close(self) -> None:
        """Stop its driving, and send it nothing more."""
        self._hub.pages.discard(self)
        if self._hub.commands:
            self._hub.commands.switch.forget(self)

    def update(self, now: float) -> None:
        """Send what is new, unless the last update has not been acknowledged."""
        if self._unseen is not None:
            return
        news = self._hub.news
        update: Dict[str, Any] = news.since(self._told, () if self.shows_wire else (FRAMES,))
        if not self._told:
            update['control'] = self._hub.commands is not None
        self._told, self._unseen = news.number, round(now, 4)
        self._write({'now': self._unseen, 'wall': round(time.time() - self._hub.clock(), 3),
                     **update})

    def _write(self, message: Dict[str, Any]) -> None:
        async def write() -> None:
            with suppress(WebSocketClosedError):
                await self.write_message(json.dumps(message, allow_nan=False))
        asyncio.ensure_future(write())

    def on_message(self, message: Any) -> None:
        """Execute what the page asks for."""
        if self not in self._hub.pages:
            return
        try:
            self._take(dict(json.loads(message, parse_float=_finite, parse_constant=_finite)))
        except _WRONG:
            self._hub.log.warn('message', f'a page at {self.request.remote_ip} sent an invalid '
                                          'message')
            self.close(1008, 'it sent an invalid message')
            self.on_close()

    def _take(self, message: Dict[str, Any]) -> None:
        if 'seen' in message:
            self._seen = float(message['seen'])
            if self._seen == self._unseen:
                self._unseen = None
        self.shows_wire = bool(message.get('wire', self.shows_wire))
        for name in ('send', 'stop', 'go', 'drive', 'release'):
            if name not in message:
                continue
            key = str(message[name].get('key', name))[:40]
            try:
                self._ask(name, key, message[name])
            except CommandRefused as refused:
                self._hub.log.warn(name, f'{name} of a page at {self.request.remote_ip} refused: '
                                         f'{refused}')
                self._write({'refused': {'key': key, 'words': str(refused)}})

    def _ask(self, name: str, key: str, values: Dict[str, Any]) -> None:
        commands = self._hub.commands
        if commands is None:
            raise CommandRefused('this panel is read-only; start it with --control')
        if name == 'stop':
            commands.stop(key)
        elif name == 'go':
            commands.go(key, self._seen)
        elif name == 'send':
            commands.send(key, self._seen, str(values['name']), dict(values['values']))
        elif name == 'drive':
            commands.drive(self, int(values['hold']), self._seen, dict(values['values']))
        else:
            commands.switch.release(self, int(values['hold']))


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f'{text} is not a number in JSON')
    return number
