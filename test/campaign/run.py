"""The campaign's hour: what is plugged, cut, stopped, disturbed and asked.

When the arduino's line freezes or goes, when it calibrates, when the bridge is stopped and when the
network fails stands in `schedule`. Beside these, at these shares of each cycle, seeded:

    0.02 … 0.26  the mcu's port flaps, twice a second
    0.09         roscore ends, and comes back (in the first cycle)
    0.12 … 0.92  nobody reads what the bridge says on stdout and stderr
    0.34 … 0.50  the bus's port flaps, twice a second
    0.75         bus and mcu go for a second

and all the time one subscriber is stopped for seconds, two processes take what CPU they get, the
boards have every fault they know, and noise comes on the lines.
"""
import heapq
import itertools
import json
import os
import random
import signal
import sys
import time
from typing import Any, Callable, Dict, FrozenSet, Iterator, List, Tuple

import psutil
import rosgraph
from tqdm import tqdm

from heartbeats import processor_wait
from processes import Child
from serial_communication.tools.watch.topics import NODE
from .check_bus import answered
from .check_interference import registered
from .expected import LINKS, OWN_ROWS
from .network import Relay
from .records import Intervals, Lines, read_lines, stretches
from .schedule import (CALIBRATION, CUTS, FROZEN, IN_TURN, LONGER, NETWORK_FROZEN, QUIET, STOPPED,
                       Turn, cycles)
from .stage import CampaignStage, Pipe, say

FLAP = 0.25              # s down, and as long up: twice a second
PARAMETERS: Dict[str, Any] = {
    'bus/motion_timeout': 0.5, 'bus/reply_timeout': 0.3, 'publish_tf': True}
SPEED_TIMEOUT = 0.5      # the node's default
TIMEOUTS = {'lift': PARAMETERS['bus/motion_timeout'], 'gimbal': PARAMETERS['bus/motion_timeout'],
            'raw': PARAMETERS['bus/reply_timeout'],
            'own': OWN_ROWS['bus']['functions']['press']['timeout']}      # of each kind of call
BOARD_OPTIONS = {'bus': ('--lift-speed', '100000', '--gimbal-speed', '100000'),
                 # Damage takes a SPEED 0 too seldom to show within a minute that one is not enough.
                 'arduino': ('--calibration-time', f'{CALIBRATION:g}', '--lose-stops'),
                 'mcu': ()}
NETWORK = '/network'     # the namespace of a second bridge, whose board is behind a network
_DROPPED_AFTER = 0.8     # s after a line froze, from when the bridge has no room to write
_FILL_PERIOD = 0.05      # s
_NO_MASTER = 1.0         # s
_LOOK_PERIOD = 0.1       # s from one look at a new master to the next
_SHOW_PERIOD = 5          # s from one look at what has been recorded to the next
_DRAIN = 1.5             # s for what is on its way at the end


class Campaign:
    """One run on a stage.

    Args:
        busy: processes that take what CPU they get.
    """

    def __init__(self, stage: CampaignStage, duration: float, seed: int, busy: int) -> None:
        self._stage = stage
        self._duration = duration
        self._seed = seed
        self._number_busy = busy
        self._busy: List[Child] = []
        self._random = random.Random(f'campaign {seed}')
        self._due: List[Tuple[float, int, Callable[[float], None]]] = []
        self._count = itertools.count()
        self._usage = Lines(stage.path('usage.jsonl'))
        self._children: Dict[str, Child] = {}
        self._end = 0.0

    def run(self) -> None:
        """All of it; returns with every child but the roscore ended."""
        stage = self._stage
        say('starting')
        self._set_up()
        start = time.monotonic()
        self._end = start + self._duration
        stage.events.write(t=start, ev='begin', seed=self._seed, duration=self._duration)
        self._plan(start)
        watch = Watch(stage, self._children['bridge'])
        with tqdm(total=round(self._duration), desc='faults', unit=' s',
                  mininterval=1.0 if sys.stderr.isatty() else 60.0) as bar:
            self._at(start + _SHOW_PERIOD, lambda due: self._show(due, bar, watch))
            self._carry_out()
        say('ending')
        self._finish()

    def _show(self, due: float, bar: tqdm, watch: 'Watch') -> None:
        bar.set_postfix_str(watch.note(), refresh=False)
        bar.update(_SHOW_PERIOD)
        self._at(due + _SHOW_PERIOD, lambda due: self._show(due, bar, watch))

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
        rows = stage.path('own_messages.yaml')
        with open(rows, 'w', encoding='utf-8') as file:
            json.dump(OWN_ROWS, file)       # which is YAML, too
        for link in LINKS:
            cable = stage.cable(link)
            self._children[link] = stage.board(link, cable.far, seed, '--fault', 'all',
                                               '--config', rows, *BOARD_OPTIONS[link])
        children = self._children
        self._pipe = pipe = Pipe(stage, stage.path('said'), stage.path('bridge.out'))
        children['bridge'] = stage.bridge(
            {link: cable.near for link, cable in stage.cables.items()},
            {**PARAMETERS, **{f'{link}/{what}': json.dumps(entries)
                              for link, own in OWN_ROWS.items()
                              for what, entries in own.items()}},
            stdout=pipe.writer, stderr=pipe.writer)
        self._relay = relay = Relay(stage.events)
        relay.start()
        children['network board'] = stage.board('arduino', relay.board, seed, name='network board',
                                                journal=stage.path('network.journal'))
        children['network bridge'] = stage.bridge({'arduino': relay.url}, {}, 'network bridge',
                                                  namespace=NETWORK)
        children['network commander'] = stage.user(
            'commander', 'network_commands.jsonl', seed, f'{NODE}/speed:={NETWORK}{NODE}/speed',
            *(f'{NODE}/{name}:={NETWORK}{NODE}/{name}' for name in ('steering', 'led', 'winch')),
            name='network commander', orders=True)
        for role, file, orders in (('recorder', 'messages.bin', False),
                                   ('traffic', 'traffic.bin', False), ('sleeper', 'none', False),
                                   ('callers', 'calls.jsonl', False),
                                   ('commander', 'commands.jsonl', True)):
            children[role] = stage.user(role, file, seed, orders=orders)
        self._busy = stage.busy(self._number_busy)
        children['metronome'] = stage.user('metronome', 'metronome.jsonl', seed)
        stage.wait(self._flows, f"data from the bridge: {children['bridge'].log}")

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
        for name in 'callers', 'commander', 'network commander', 'network bridge', 'network board':
            stage.end(children[name])
        self._relay.close()
        time.sleep(_DRAIN)
        alive = children['bridge'].alive
        stage.events.write(t=time.monotonic(), ev='finish', alive=alive)
        took = stage.end(children['bridge'], signal.SIGINT)
        stage.events.write(t=time.monotonic(), ev='bridge ended', seconds=took,
                           status=children['bridge'].process.returncode)
        self._pipe.take()
        self._pipe.close()
        time.sleep(0.3)
        for name in ('recorder', 'traffic', 'sleeper', *LINKS, 'metronome'):
            stage.end(children[name])
        for cable in list(stage.cables.values()):
            cable.unplug()
        self._usage.close()

    # -- what happens when ------------------------------------------------------------------

    def _plan(self, start: float) -> None:
        number, cycle = cycles(self._duration)
        for index in range(number):
            self._plan_cycle(start + index * cycle, cycle)
        self._at(start + 0.5, self._sample)
        self._at(start + 1.0, self._stop_subscriber)
        self._at(start + 0.09 * cycle, self._restart_master)
        for link in ('bus', 'mcu', 'arduino'):
            self._at(start + 1.0, lambda due, link=link: self._noise(due, link))

    def _plan_cycle(self, start: float, cycle: float) -> None:
        def at(share: float) -> float:
            return start + share * cycle

        cuts = iter(CUTS)
        for turn in IN_TURN['arduino']:
            self._plan_turn(turn, at(turn.share), cuts)
        self._flap('mcu', at(0.02), at(0.26))
        self._flap('bus', at(0.34), at(0.50))
        for link in 'bus', 'mcu':
            self._cut(link, at(0.75), 1.0, self._random.random() < 0.5)
        self._at(at(0.12), lambda due: self._pipe.leave())
        self._at(at(0.92), lambda due: self._pipe.come_back())
        for turn in IN_TURN['network']:
            if turn.what == 'freeze':
                self._at(at(turn.share), lambda due: self._relay.freeze())
                self._at(at(turn.share) + NETWORK_FROZEN, lambda due: self._relay.thaw())
            else:
                self._at(at(turn.share), lambda due: self._relay.vanish())

    def _plan_turn(self, turn: Turn, when: float, cuts: Iterator[float]) -> None:
        """A fault of the arduino's line, or of the bridge; `cuts`: seconds of those to come."""
        if turn.what == 'freeze':
            self._freeze_line('arduino', when)
        elif turn.what == 'stop':
            self._at(when, self._stop_bridge)
        elif turn.what == 'cut':
            # Each time for longer, and with the time to come back that is asked for.
            seconds = next(cuts)
            self._cut('arduino', when, seconds * self._random.uniform(0.7, LONGER),
                      seconds == CUTS[1])
        else:
            self._at(when, self._calibrate)
            if turn.what == 'calibrate and cut':
                self._cut('arduino', when + self._random.uniform(0.3, 2.0), 0.8, True)

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

    def _freeze_line(self, link: str, when: float) -> None:
        """The board reads nothing, and a little later the bridge has no room to write."""
        cable = self._stage.cables[link]
        self._at(when, lambda due: cable.freeze(self._children['bridge']))
        filled = when + _DROPPED_AFTER
        while filled < when + FROZEN:
            self._at(filled, lambda due: cable.fill())
            filled += _FILL_PERIOD
        self._at(when + FROZEN, lambda due: cable.thaw())

    def _stop_bridge(self, due: float) -> None:
        self._tell_bridge('stopped', signal.SIGSTOP)
        self._at(due + STOPPED, lambda due: self._tell_bridge('continued', signal.SIGCONT))

    def _tell_bridge(self, event: str, number: int) -> None:
        self._stage.events.write(t=time.monotonic(), ev=event)
        self._children['bridge'].send(number)

    def _restart_master(self, due: float) -> None:
        before = self._registered()
        self._stage.events.write(t=time.monotonic(), ev='master ended')
        self._stage.ask_master_to_end()

        def start(due: float) -> None:
            if self._stage.master_runs:     # nothing else may wait for its end
                self._at(due + _LOOK_PERIOD, start)
                return
            self._stage.end_master()
            self._stage.launch_master()
            self._stage.events.write(t=time.monotonic(), ev='master started')
            self._at(time.monotonic() + _LOOK_PERIOD, look)

        def look(due: float) -> None:
            if self._registered() >= before:
                self._stage.events.write(t=time.monotonic(), ev='registered')
            else:
                self._at(due + _LOOK_PERIOD, look)

        self._at(due + _NO_MASTER, start)

    @staticmethod
    def _registered() -> FrozenSet[Tuple[str, str]]:
        """What the master knows of the bridge; nothing where none answers."""
        master = rosgraph.Master('/stage')
        try:
            return registered(master.getSystemState(), master.getParam(NODE), NODE)
        except (OSError, rosgraph.MasterException):
            return frozenset()

    def _calibrate(self, _due: float) -> None:
        self._children['commander'].order('calibrate')

    def _stop_subscriber(self, due: float) -> None:
        sleeper = self._children['sleeper']
        sleeper.send(signal.SIGSTOP)
        again = due + self._random.uniform(2.0, 6.0)
        self._at(again, lambda _due: sleeper.send(signal.SIGCONT))
        self._at(again + self._random.uniform(0.5, 2.0), self._stop_subscriber)

    def _noise(self, due: float, link: str) -> None:
        if due < self._end - QUIET:
            size = self._random.choice((1, 2, 3, 8, 20, 60))
            self._stage.cables[link].noise(bytes(
                self._random.choice((0xA5, 0x5A, 0x02, 0x03, 0x00, self._random.randrange(256)))
                for _ in range(size)))
        rate = {'bus': 0.8, 'mcu': 0.5, 'arduino': 4.0}[link]
        self._at(due + self._random.expovariate(1 / rate) + 0.05,
                 lambda due, link=link: self._noise(due, link))

    def _sample(self, due: float) -> None:
        """What the node takes, and says, once a second."""
        self._pipe.take()
        usage = usage_of(self._children['bridge'].pid)
        if usage:
            self._usage.write(t=time.monotonic(), **usage)
        self._at(due + 1.0, self._sample)


class Watch:
    """What shows while a campaign runs: the rest is judged when all records are there.

    Args:
        stage: with the records of the callers and of the campaign itself.
    """

    def __init__(self, stage: CampaignStage, bridge: Child) -> None:
        self._file = open(stage.path('calls.jsonl'))
        self._events = stage.path('events.jsonl')
        self._bridge = bridge
        self._calls = self._violations = 0
        self._rest = ''

    def note(self) -> str:
        """In a few words."""
        lines = (self._rest + self._file.read()).split('\n')
        self._rest = lines.pop()
        calls = [json.loads(line) for line in lines]
        self._calls += len(calls)
        self._violations += len(answered(calls, TIMEOUTS, *excuses_of_calls(
            read_lines(self._events), time.monotonic())).violations)
        dead = '' if self._bridge.alive else ', the node has ended'
        return f'{self._calls} calls, violations so far: {self._violations}{dead}'


def excuses_of_calls(events: List[Dict], end: float) -> Tuple[Intervals, Intervals]:
    """When the bridge was stopped, and when no master knew it."""
    return (stretches(events, 'stopped', 'continued', end),
            stretches(events, 'master ended', 'registered', end))


def usage_of(pid: int) -> Dict[str, float]:
    """Resident MB, threads and open files; empty if it has ended."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            return {'memory': process.memory_info().rss / (1 << 20),
                    'threads': process.num_threads(), 'files': process.num_fds(),
                    'waited': round(processor_wait(pid), 3)}
    except (OSError, psutil.Error):
        return {}
