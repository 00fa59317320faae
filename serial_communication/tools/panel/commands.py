"""The commands of the page, with --control: calls, messages to the boards, driving, STOP.

All of it runs on the IO loop, but the calls, which may take seconds, and the making of publishers,
for which the master is asked.
"""
import math
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Callable, Collection, Dict, List, Optional, Tuple

import rospy
from std_srvs.srv import SetBool, SetBoolRequest

from ...ros.background import LatestWorker
from ..watch.calls import MOST_WAIT, Answer, Verdict, call
from ..watch.state import BridgeState
from ..watch.topics import absolute
from .driving import CommandRefused, DeadManSwitch, Hold
from .forms import Form, forms
from .news import News

_STOP_ANSWER = 0.5      # s for the bridge to answer a STOP; then zeros are published
_MAX_AGE = MOST_WAIT    # s from a click until its request is sent; later it is refused
_MOST_CALLS = 30        # that the pages are told
_AT_ONCE = 8            # calls; a STOP waits for none of them


class Outlet:
    """Publishers of the topics that a bridge subscribes to. `worker` makes them."""

    def __init__(self, bridge: BridgeState, worker: LatestWorker) -> None:
        self._bridge = bridge
        self._worker = worker
        self._wanted: Dict[str, Any] = {}       # classes by full name
        self._publishers: Dict[str, rospy.Publisher] = {}

    def want(self, classes: Dict[str, Any]) -> None:
        """Have publishers of these classes, by names relative to the node, and no others."""
        wanted = {absolute(name, self._bridge.node): each for name, each in classes.items()}
        if wanted != self._wanted:
            self._wanted = wanted
            self._worker.submit(self._register)

    def _register(self) -> None:
        wanted = self._wanted
        for name, publisher in list(self._publishers.items()):
            if publisher.data_class is not wanted.get(name):
                del self._publishers[name]
                publisher.unregister()
        for name in set(wanted) - set(self._publishers):
            self._publishers[name] = rospy.Publisher(name, wanted[name], queue_size=1,
                                                     tcp_nodelay=True)

    def publish(self, messages: Dict[str, Any]) -> None:
        """Publish all of these messages; or none of them, and raise CommandRefused."""
        found = [(self._publisher(absolute(name, self._bridge.node)), message)
                 for name, message in messages.items()]
        for publisher, message in found:
            if message._has_header:
                message.header.stamp = rospy.Time.now()
            with suppress(rospy.ROSException):      # rospy shuts down
                publisher.publish(message)

    def _publisher(self, name: str) -> rospy.Publisher:
        publisher = self._publishers.get(name)
        if publisher is None or not publisher.impl.has_connection(self._bridge.node):
            raise CommandRefused(f'nothing was sent: the bridge does not subscribe to {name}: it '
                                 'does not run, or that link is off')
        return publisher


class Commands:
    """Executes the commands of all pages, and tells `news` their answers.

    Args:
        add_callback: runs a function soon on the IO loop; may be called from any thread.
    """

    def __init__(self, bridge: BridgeState, outlet: Outlet, news: News, add_callback: Callable,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._bridge = bridge
        self._outlet = outlet
        self._news = news
        self._add_callback = add_callback
        self._clock = clock
        self._offered: Any = None       # what the next is made from
        self._forms: Dict[str, Form] = {}
        self.switch = DeadManSwitch(self._zero)
        self._stops: List[Tuple[float, Dict[str, Any]]] = []    # when each must be answered
        self._calls = 0
        self._workers, self._stoppers = ThreadPoolExecutor(_AT_ONCE), ThreadPoolExecutor(_AT_ONCE)

    def tick(self, now: float, active: bool) -> None:
        """Do what is due now, every 50 ms. While no page is open (`active`), nothing is
        advertised."""
        self.switch.check(now)
        for due, entry in self._stops[:]:
            if now >= due or 'outcome' in entry:
                self._stops.remove((due, entry))
                if entry.get('outcome') != Verdict.DONE.value:
                    self._zero(self._forms)
        self._news.tell('state', 'drives', self.switch.hold is not None)
        offered = self._bridge.parameters, active
        if offered != self._offered:
            self._offered = offered
            self._forms = forms(self._bridge.boards, self._bridge.parameters)
            self._outlet.want({name: form.ros_class for name, form in self._forms.items()
                               if active and not form.service})
            self._news.tell('state', 'forms', {name: each.described()
                                               for name, each in self._forms.items()})

    # -- calls and messages --------------------------------------------------------------------

    def send(self, key: str, seen: float, name: str, values: Dict[str, Any]) -> None:
        """Call the service of a form, or publish its message; or raise CommandRefused.

        Args:
            key: by which the page recognises its command.
            seen: time of the latest update that the page had seen, s. A request that a network or
                a suspended process has delayed must not move the robot.
        """
        if name not in self._forms:
            raise CommandRefused(f'{name[:40]!r} is not a command of the page')
        deadline, form = self._deadline(seen), self._forms[name]
        made = form.make(values)
        if form.service:
            self._call(self._workers, form.service, form.ros_class, made, deadline,
                       self._entry(key, name, values), form)
        else:
            self._outlet.publish({name: made})
            self._tell({**self._entry(key, name, values), 'outcome': 'sent',
                        'words': 'to the bridge; this command has no answer'})

    def stop(self, key: str) -> None:
        """STOP, at any time and however old the command is: end any page's driving, and call
        ~stop. Zeros are published if the bridge does not confirm it in time."""
        self.switch.end()
        entry = self._entry(key, '~stop', {'data': True})
        self._stops.append((self._clock() + _STOP_ANSWER, entry))
        self._call(self._stoppers, '~stop', SetBool, SetBoolRequest(True), math.inf, entry)

    def go(self, key: str, seen: float) -> None:
        """Let everything move again; as `send`."""
        self._call(self._stoppers, '~stop', SetBool, SetBoolRequest(False), self._deadline(seen),
                   self._entry(key, '~stop', {'data': False}))

    def _deadline(self, seen: float) -> float:
        """When a command must have been sent; CommandRefused if it is too old already."""
        age = self._clock() - seen
        if not 0 <= age <= _MAX_AGE:
            raise CommandRefused(f'nothing was sent: the command is {age:.1f} s old, '
                                 f'at most {_MAX_AGE:g} s; press again')
        return time.monotonic() + _MAX_AGE - age

    def _call(self, workers: ThreadPoolExecutor, service: str, service_class: Any, request: Any,
              deadline: float, entry: Dict[str, Any], form: Optional[Form] = None) -> None:
        def run() -> None:
            answer = call(absolute(service, self._bridge.node), service_class, request, deadline)
            self._add_callback(self._answered, entry, answer, form)
        workers.submit(run)

    def _answered(self, entry: Dict[str, Any], answer: Answer, form: Optional[Form]) -> None:
        done = answer.outcome is Verdict.DONE
        entry.update(outcome=answer.outcome.value, words=answer.words,
                     took=round(self._clock() - entry['began'], 3),
                     reply=form.reply(answer.response) if form and done else [])
        self._tell(entry)

    def _entry(self, key: str, name: str, values: Dict[str, Any]) -> Dict[str, Any]:
        """The beginning of a command, as the pages are told it."""
        self._calls += 1
        entry = {'number': self._calls, 'key': key, 'name': name, 'values': values,
                 'began': round(self._clock(), 3)}
        self._tell(entry)
        return entry

    def _tell(self, entry: Dict[str, Any]) -> None:
        self._news.tell('calls', entry['number'], dict(entry), _MOST_CALLS)

    # -- driving -------------------------------------------------------------------------------

    def drive(self, page: Any, hold: int, seen: float, values: Dict[str, Dict[str, Any]]) -> None:
        """Drive until the page has not repeated this for SILENCE; or raise CommandRefused.

        Args:
            hold: number of the press that this command belongs to.
            seen: as of `send`.
            values: of the commands to publish, by field, by the name of the form.
        """
        if any(name not in self._forms or self._forms[name].service for name in values):
            raise CommandRefused('the bridge has no such motion')
        messages = {name: self._forms[name].make(given) for name, given in values.items()}
        self.switch.command(Hold(page, hold, tuple(values), self._clock()), seen)
        self._outlet.publish(messages)

    def _zero(self, names: Collection[str]) -> None:
        """Publish the zeros of the motions among these forms."""
        for name in names:
            form = self._forms.get(name)
            if form and form.moves:
                with suppress(CommandRefused):      # the bridge's own timeout stops it
                    self._outlet.publish({name: form.ros_class()})
