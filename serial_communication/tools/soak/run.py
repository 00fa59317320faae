"""The campaign's hour: what is plugged, cut, stopped, disturbed and asked, and when.

All of it repeats every `CYCLE` seconds (less, if the campaign is shorter), seeded:

    0.02 … 0.26  the mcu's port flaps, twice a second        0.30  a calibration
    0.34 … 0.54  the bus's port flaps, twice a second        0.58 … 0.69  the arduino's goes, thrice
    0.75         bus and mcu go for a second                 0.79  a calibration, and the port goes

and all the time one subscriber is stopped for seconds, two processes take what CPU they get, the
boards have every fault they know, and noise comes on the lines.
"""
import heapq
import itertools
import json
import os
import random
import signal
import time
from typing import Any, Callable, Dict, List, Tuple

from ..progress import Progress
from ..stage import LINKS, Child
from .check_bus import answered
from .records import Lines
from .stage import CampaignStage

CYCLE = 60.0
FLAP = 0.25              # s down, and as long up: twice a second
CALIBRATION = 3.0        # s that the board takes for one
PARAMETERS: Dict[str, Any] = {
    'bus/motion_timeout': 0.5, 'bus/reply_timeout': 0.3, 'publish_tf': True}
SPEED_TIMEOUT = 0.5      # the node's default
TIMEOUTS = {'lift': PARAMETERS['bus/motion_timeout'], 'gimbal': PARAMETERS['bus/motion_timeout'],
            'raw': PARAMETERS['bus/reply_timeout']}      # of each kind of call
BOARD_OPTIONS = {'bus': ('--lift-speed', '100000', '--gimbal-speed', '100000'),
                 'arduino': ('--calibration-time', '%g' % CALIBRATION), 'mcu': ()}
_QUIET = 2.5             # s at the end of a cycle, and of all, in which every port stays
_DRAIN = 1.5             # s for what is on its way at the end


class Campaign:
    """One run on a stage.

    Args:
        busy: processes that take what CPU they get.
        progress: is told what is done.
    """

    def __init__(self, stage: CampaignStage, duration: float, seed: int, busy: int,
                 progress: Progress) -> None:
        self._stage = stage
        self._duration = duration
        self._seed = seed
        self._number_busy = busy
        self._busy: List[Child] = []
        self._progress = progress
        self._random = random.Random('campaign %d' % seed)
        self._due: List[Tuple[float, int, Callable[[float], None]]] = []
        self._count = itertools.count()
        self._usage = Lines(stage.path('usage.jsonl'))
        self._children: Dict[str, Child] = {}
        self._end = 0.0

    def run(self) -> None:
        """All of it; returns with every child but the roscore ended."""
        stage = self._stage
        with self._progress.phase('starting'):
            self._set_up()
        start = time.monotonic()
        self._end = start + self._duration
        stage.events.write(t=start, ev='begin', seed=self._seed, duration=self._duration)
        self._plan(start)
        watch = Watch(stage.path('calls.jsonl'), self._children['bridge'])
        with self._progress.phase(f'{self._duration:.0f} s of faults', watch.note):
            self._carry_out()
        with self._progress.phase('ending'):
            self._finish()

    def _carry_out(self) -> None:
        """The plan."""
        while True:
            now = time.monotonic()
            if now >= self._end:
                break
            if self._due and self._due[0][0] <= now:
                due, _count, action = heapq.heappop(self._due)
                action(due)
                continue
            time.sleep(min(self._end, self._due[0][0] if self._due else self._end) - now)

    # -- beginning and end ------------------------------------------------------------------

    def _set_up(self) -> None:
        stage, seed = self._stage, self._seed
        for link in LINKS:
            cable = stage.cable(link)
            self._children[link] = stage.board(link, cable.far, seed, '--fault', 'all',
                                               *BOARD_OPTIONS[link])
        children = self._children
        children['bridge'] = stage.bridge(
            {link: cable.near for link, cable in stage.cables.items()}, PARAMETERS)
        for role, file, orders in (('recorder', 'messages.bin', False),
                                   ('traffic', 'traffic.bin', False), ('sleeper', 'none', False),
                                   ('callers', 'calls.jsonl', False),
                                   ('commander', 'commands.jsonl', True)):
            children[role] = stage.user(role, file, seed, orders=orders)
        self._busy = stage.busy(self._number_busy)
        children['metronome'] = stage.user('metronome', 'metronome.jsonl', seed)
        stage.wait(self._flows, 'data from the bridge: %s' % children['bridge'].log)

    def _flows(self) -> bool:
        """Whether everything has begun."""
        paths = {name: self._stage.path(name) for name in
                 ('messages.bin', 'traffic.bin', 'calls.jsonl', 'commands.jsonl')}
        sizes = {name: os.path.getsize(path) if os.path.exists(path) else 0
                 for name, path in paths.items()}
        return (sizes['messages.bin'] > 50000 and sizes['traffic.bin'] > 20000
                and sizes['calls.jsonl'] > 500 and sizes['commands.jsonl'] > 200)

    def _finish(self) -> None:
        stage, children = self._stage, self._children
        for child in self._busy:
            stage.end(child)
        children['sleeper'].send(signal.SIGCONT)
        for name in 'callers', 'commander':
            stage.end(children[name])
        time.sleep(_DRAIN)
        alive = children['bridge'].alive
        stage.events.write(t=time.monotonic(), ev='finish', alive=alive)
        took = stage.end(children['bridge'], signal.SIGINT)
        stage.events.write(t=time.monotonic(), ev='bridge ended', seconds=took,
                           status=children['bridge'].process.returncode)
        time.sleep(0.3)
        for name in ('recorder', 'traffic', 'sleeper', 'bus', 'arduino', 'mcu', 'metronome'):
            stage.end(children[name])
        for cable in list(stage.cables.values()):
            cable.unplug()
        self._usage.close()

    # -- what happens when ------------------------------------------------------------------

    def _plan(self, start: float) -> None:
        cycle = min(CYCLE, self._duration)
        rounds = max(1, round(self._duration / cycle))
        for number in range(rounds):
            self._plan_cycle(start + number * cycle, cycle)
        self._at(start + 0.5, self._sample)
        self._at(start + 1.0, self._stop_subscriber)
        for link in ('bus', 'mcu', 'arduino'):
            self._at(start + 1.0, lambda due, link=link: self._noise(due, link))

    def _plan_cycle(self, start: float, cycle: float) -> None:
        def at(share: float) -> float:
            return start + share * cycle

        self._flap('mcu', at(0.02), at(0.26))
        self._at(at(0.30), self._calibrate)
        self._flap('bus', at(0.34), at(0.54))
        # Each time for longer, and with the time to come back that is asked for.
        for index, share in enumerate((0.58, 0.63, 0.69)):
            self._cut('arduino', at(share), (0.15, 0.5, 1.2)[index] * self._random.uniform(
                0.7, 1.2), index == 1)
        for link in 'bus', 'mcu':
            self._cut(link, at(0.75), 1.0, self._random.random() < 0.5)
        self._at(at(0.79), self._calibrate)
        self._cut('arduino', at(0.79) + self._random.uniform(0.3, 2.0), 0.8, True)

    def _at(self, when: float, action: Callable[[float], None]) -> None:
        heapq.heappush(self._due, (when, next(self._count), action))

    def _flap(self, link: str, start: float, end: float) -> None:
        count = int((end - start) / (2 * FLAP))
        for index in range(count):
            self._cut(link, start + 2 * FLAP * index, FLAP, index % 3 == 2)

    def _cut(self, link: str, when: float, seconds: float, another_name: bool) -> None:
        cable = self._stage.cables[link]
        self._at(when, lambda due: cable.unplug(another_name))
        self._at(when + seconds, lambda due: cable.plug())

    def _calibrate(self, _due: float) -> None:
        self._children['commander'].order('calibrate')

    def _stop_subscriber(self, due: float) -> None:
        sleeper = self._children['sleeper']
        sleeper.send(signal.SIGSTOP)
        again = due + self._random.uniform(2.0, 6.0)
        self._at(again, lambda _due: sleeper.send(signal.SIGCONT))
        self._at(again + self._random.uniform(0.5, 2.0), self._stop_subscriber)

    def _noise(self, due: float, link: str) -> None:
        if due < self._end - _QUIET:
            size = self._random.choice((1, 2, 3, 8, 20, 60))
            self._stage.cables[link].noise(bytes(
                self._random.choice((0xA5, 0x5A, 0x02, 0x03, 0x00, self._random.randrange(256)))
                for _ in range(size)))
        rate = {'bus': 0.8, 'mcu': 0.5, 'arduino': 4.0}[link]
        self._at(due + self._random.expovariate(1 / rate) + 0.05,
                 lambda due, link=link: self._noise(due, link))

    def _sample(self, due: float) -> None:
        """What the node takes, once a second."""
        usage = usage_of(self._children['bridge'].pid)
        if usage:
            self._usage.write(t=time.monotonic(), **usage)
        self._at(due + 1.0, self._sample)


class Watch:
    """What shows while a campaign runs: the rest is judged when all records are there.

    Args:
        calls: the file of the callers.
    """

    def __init__(self, calls: str, bridge: Child) -> None:
        self._file = open(calls)
        self._bridge = bridge
        self._calls = self._violations = 0
        self._rest = ''

    def note(self) -> str:
        """In a few words."""
        lines = (self._rest + self._file.read()).split('\n')
        self._rest = lines.pop()
        calls = [json.loads(line) for line in lines]
        self._calls += len(calls)
        self._violations += len(answered(calls, TIMEOUTS).violations)
        dead = '' if self._bridge.alive else ', the node has ended'
        return f'{self._calls} calls, violations so far: {self._violations}{dead}'


def seconds_of(duration: float) -> float:
    """About how long a campaign takes with all that comes before and after its faults."""
    return 45.0 + 1.2 * duration


def usage_of(pid: int) -> Dict[str, float]:
    """Resident MB, threads and open files; empty if it has ended."""
    try:
        with open('/proc/%d/status' % pid) as status:
            values = dict(line.split(':', 1) for line in status)
        return {'memory': int(values['VmRSS'].split()[0]) / 1024,
                'threads': int(values['Threads']),
                'files': len(os.listdir('/proc/%d/fd' % pid)), 'waited': _waited(pid)}
    except (OSError, KeyError, ValueError):
        return {}


def _waited(pid: int) -> float:
    """Seconds that its threads were ready to run and did not, all together."""
    total = 0
    for thread in os.listdir('/proc/%d/task' % pid):
        try:
            with open('/proc/%d/task/%s/schedstat' % (pid, thread)) as file:
                total += int(file.read().split()[1])
        except (OSError, ValueError, IndexError):
            pass
    return round(total / 1e9, 3)
