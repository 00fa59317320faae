"""What the bench measures: one function for each section.

The sides of a comparison run at the same time and take turns, A B C A B C …. The best round of each
figure counts, so that other load on the machine has little effect. Less is better for all figures.
"""
import json
import time
from collections import Counter
from math import inf
from pathlib import Path
from statistics import median, pstdev
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Sequence, Tuple

from rosgraph.names import resolve_name
from tqdm import tqdm

from serial_communication.boards import description
from .nodes import topics_of_boards
from .processes import Child, StageError
from .report import (CPU, SCHEDSTAT, Figures, Results, best, gaps_in_queue, latencies,
                     percentile, stamp_errors)
from .stage import BenchStage, Servant, Side

_SETTLE = 0.2          # s until messages under way have arrived
_CALLERS = 8
_IN_QUEUE = 0.002      # s after which a call is certainly in the node's queue
_FLOOD = 1000000       # baud
_ALL, _CPU_MS, _WAKES = 'all threads', 'ms', 'wake-ups'     # see threads_of


class Plan(NamedTuple):
    """The duration and size of a measurement."""

    seconds: float     # for each round
    rounds: int
    bridges: int       # at the same time, in the section `bridges`


Measure = Callable[[], Figures]


def _in_turn(plan: Plan, sides: Dict[str, Measure]) -> Results:
    """Measure the sides in turn; return the best figures of each."""
    found: Dict[str, List[Figures]] = {name: [] for name in sides}
    for _ in tqdm(range(plan.rounds), 'rounds', leave=False, disable=None):
        for name, measure in sides.items():
            found[name].append(measure())
    return {name: best(rounds) for name, rounds in found.items()}


def _cost(children: Sequence[Child], work: Callable[[], Any]) -> Tuple[Figures, Any]:
    """Return the CPU time of each child during `work`, by both of the kernel's counts, and the
    result of `work`."""
    def spent() -> List[float]:
        return [sum(child.cpu_seconds() for child in children),
                sum(threads_of(child.pid)[_ALL, _CPU_MS] for child in children) / 1e3]

    before, start = spent(), time.monotonic()
    result = work()
    percent = 100 / (time.monotonic() - start) / len(children)
    return {name: (after - then) * percent
            for name, after, then in zip((CPU, SCHEDSTAT), spent(), before)}, result


def threads_of(pid: int) -> Counter:
    """Return the CPU time in ms, and how often it was woken, of each thread of a process so far, by
    (name, _CPU_MS or _WAKES). The name _ALL stands for all threads."""
    found: Counter = Counter()
    for task in Path(f'/proc/{pid}/task').iterdir():
        try:
            nanoseconds = int((task / 'schedstat').read_text().split()[0])
            wakes = (task / 'status').read_text().split('voluntary_ctxt_switches:')[1].split()[0]
            for name in _ALL, (task / 'comm').read_text().strip():
                found[name, _CPU_MS] += nanoseconds / 1e6
                found[name, _WAKES] += int(wakes)
        except OSError:     # it has ended
            continue
    return found


def thread_figures(before: Counter, after: Counter, seconds: float, packets: int) -> Figures:
    """Return the figures of each thread for this time, in which so many packets were sent."""
    after = after.copy()
    after.subtract(before)
    return {f'{name}, ms in 10 s' if what == _CPU_MS else f'{name}, wake-ups per packet':
            count * 10 / seconds if what == _CPU_MS else count / packets
            for (name, what), count in after.items()}


def _figure(function: Callable[[List[float]], float], seconds: List[float]) -> float:
    """Return a function of seconds in ms; infinite without values."""
    return 1e3 * function(seconds) if seconds else inf


def _p99(seconds: List[float]) -> float:
    return _figure(lambda values: percentile(values, 99), seconds)


# -- one board, IMU and steering subscribed -------------------------------------------------------

def latency(stage: BenchStage, plan: Plan, busy: int = 0) -> Results:
    """Latency from the board's write to the subscriber's callback; heartbeats; CPU by thread."""
    sides = {name: stage.side(name, ('arduino',)) for name in (*stage.bridges, 'polling')}
    subscriber = _subscriber(stage, sides.values())
    for side in sides.values():
        stage.wait(lambda: side.talk(0.2) and subscriber.ask('take', node=side.node),
                   f'the first packets of {side.node}')
    stage.busy(busy)
    return _in_turn(plan, {name: lambda side=side: _latency(side, subscriber, plan.seconds)
                           for name, side in sides.items()})


def _subscriber(stage: BenchStage, sides: Iterable[Side]) -> Servant:
    """Start the subscriber of IMU and steering, and wait until it is connected to every side."""
    subscriber = stage.servant('nodes', 'subscriber', *[side.node for side in sides])
    try:
        stage.wait(lambda: not subscriber.ask('missing'), 'IMU and steering are connected')
    except StageError as error:
        ended = [side.node for side in sides if not side.child.alive]
        raise StageError(f"{error}; missing: {subscriber.ask('missing')}; ended: {ended}") from None
    return subscriber


def _latency(side: Side, subscriber: Servant, seconds: float) -> Figures:
    side.others['listener'].ask('take')
    subscriber.ask('take', node=side.node)
    before = threads_of(side.child.pid)
    cost, sent = _cost([side.child], lambda: side.talk(seconds)['arduino'])
    threads = thread_figures(before, threads_of(side.child.pid), seconds, sum(map(len, sent)))
    beats = side.others['listener'].ask('take')
    time.sleep(_SETTLE)
    found = latencies(sent, subscriber.ask('take', node=side.node))
    gaps = [after - then for then, after in zip(beats, beats[1:])]
    return {'p50, ms': _figure(median, found),
            'p99, ms': _p99(found),
            'lost': 2 * len(sent) - len(found), **cost,
            'heartbeat: deviation, ms': _figure(pstdev, gaps),
            'heartbeat: p99.9, ms': _figure(lambda values: percentile(values, 99.9), gaps),
            **threads}


def busy(stage: BenchStage, plan: Plan) -> Results:
    """The same with two busy processes."""
    return latency(stage, plan, busy=2)


# -- every board, every topic subscribed, or none -------------------------------------------------

def cpu(stage: BenchStage, plan: Plan) -> Results:
    """CPU with every topic subscribed, with none, and of the node that only publishes."""
    counter = stage.servant('nodes', 'counter')
    subscribed = {name: stage.side(name) for name in stage.bridges}
    unsubscribed = {name: stage.side(name) for name in stage.bridges}
    publishing = stage.servant('nodes', 'publishing', namespace='/publishing')
    for side in subscribed.values():
        _connect(stage, counter, side.node, [*topics_of_boards(), 'diagnostics'])
    _connect(stage, counter, '/publishing/serial_communication',
             [*topics_of_boards(), 'diagnostics'])
    for side in [*subscribed.values(), *unsubscribed.values()]:
        _first_messages(stage, side)
    rates = _rates(counter, subscribed['bridge'], plan.seconds)

    def work(child: Child, load: Callable[[], Any]) -> Measure:
        return lambda: _cost([child], load)[0]

    return _in_turn(plan, {
        **{name: work(side.child, lambda side=side: side.talk(plan.seconds))
           for name, side in subscribed.items()},
        **{f'{name}, no subscriber': work(side.child, lambda side=side: side.talk(plan.seconds))
           for name, side in unsubscribed.items()},
        'publishing': work(publishing, lambda: publishing.ask(
            'publish', rates=rates, seconds=plan.seconds))})


def _connect(stage: BenchStage, counter: Servant, node: str, topics: Iterable[str]) -> None:
    names = [resolve_name(topic, node) for topic in topics]
    stage.wait(lambda: counter.ask('connect', node=node, topics=names), f'{node} runs')
    stage.wait(lambda: not counter.ask('waiting'), f'every topic of {node} is connected')


def _first_messages(stage: BenchStage, side: Side) -> None:
    """Wait until the node has opened its ports: it sends heartbeats and reads its boards."""
    stage.wait(lambda: side.others['listener'].ask('take'), f'the first heartbeat of {side.node}')
    side.talk(0.5)


def _rates(counter: Servant, side: Side, seconds: float) -> Dict[str, int]:
    """Return the rate in Hz of each topic with messages, by its name relative to the node."""
    counter.ask('take')
    side.talk(seconds)
    counts = counter.ask('take')
    rates = {topic: counts[resolve_name(topic, side.node)] / seconds
             for topic in [*topics_of_boards(), 'diagnostics']}
    return {topic: max(1, round(rate)) for topic, rate in rates.items() if rate}


def bridges(stage: BenchStage, plan: Plan) -> Results:
    """CPU of each of several bridges under one master, and of one while the others wait."""
    counter = stage.servant('nodes', 'counter')
    sides = [stage.side('bridge') for _ in range(plan.bridges)]
    for side in sides:
        _connect(stage, counter, side.node, topics_of_boards())
        _first_messages(stage, side)

    def measure(talking: List[Side]) -> Measure:
        def load() -> None:
            for side in talking:
                side.begin_talking(plan.seconds)
            for side in talking:
                side.end_talking()
        return lambda: _cost([side.child for side in talking], load)[0]

    return _in_turn(plan, {'one': measure(sides[:1]), 'all': measure(sides)})


def stamps(stage: BenchStage, plan: Plan) -> Results:
    """Stamps of a board's clock (300 ppm fast, 100 Hz) that was started twice a round before, and
    of reads of a board without, at the same time: on a tty, behind an adapter that delivers each 1
    or 16 ms, and on a tty beside two busy processes."""
    ppms = {'board': 300.0, 'read': None}
    sides = {name: stage.side('bridge', ('arduino',)) for name in ppms}
    subscriber = _subscriber(stage, sides.values())
    for side in sides.values():
        _first_messages(stage, side)

    def round_with(batch: float, seconds: float) -> Figures:
        figures: Figures = {}
        for side in sides.values():
            subscriber.ask('take', node=side.node)
        before = {name: threads_of(side.child.pid)[_ALL, _CPU_MS] for name, side in sides.items()}
        for name, side in sides.items():
            side.talkers['arduino'].begin('measure', seconds=seconds, ppm=ppms[name], batch=batch)
        sent = {name: side.talkers['arduino'].answer() for name, side in sides.items()}
        time.sleep(_SETTLE)
        for name, side in sides.items():
            errors, distances = stamp_errors(sent[name], subscriber.ask('take', node=side.node))
            figures.update({
                **_error_figures(name, errors), f'{name}: distance p99, ms': _p99(distances),
                f'{name}: {SCHEDSTAT}':
                    (threads_of(side.child.pid)[_ALL, _CPU_MS] - before[name]) / 10 / seconds})
        return figures

    def line(batch: float) -> Figures:
        # The lines are not compared. Each begins with a clock that the bridge does not know.
        sides['board'].talkers['arduino'].ask('boot')
        round_with(batch, 2 * plan.seconds)
        return _in_turn(plan, {'': lambda: round_with(batch, plan.seconds)})['']

    found = {name: line(batch) for name, batch in (('tty', 0.0), ('1 ms', 0.001), ('16 ms', 0.016))}
    stage.busy(2)
    return {**found, 'busy': line(0.0)}


def nano(stage: BenchStage, plan: Plan) -> Results:
    """Stamps of the emulated Nano, from 10 s after its start: its line delivers each 1 ms, and an
    adapter behind it each 16 ms. Without the rounds in which the emulator stalled."""
    # The board is another computer; its emulator inherits the priority.
    servant = stage.servant('nano', 'nano', priority=5)

    def round_with(batch: float) -> Figures:
        found = servant.ask('measure', seconds=plan.seconds, batch=batch)
        return {**_error_figures('board', found['board']),
                'board: distance p99, ms': _p99(found['distance']),
                **_error_figures('read', found['read'])}

    return _in_turn(plan, {name: lambda batch=batch: round_with(batch)
                           for name, batch in (('1 ms', 0.0), ('16 ms', 0.016))})


def _error_figures(name: str, errors: List[float]) -> Figures:
    return {f'{name}: error p50, ms': _figure(median, errors),
            f'{name}: error p99, ms': _p99(errors)}


def flood(stage: BenchStage, plan: Plan) -> Results:
    """Losses with packets back to back at 1 Mbaud and every topic subscribed."""
    counter = stage.servant('nodes', 'counter')
    topics = [topic.name for topic in description('arduino').topics
              if topic.ages and not topic.optional]
    sides = {name: stage.side(name, ('arduino',), {'arduino/baud': _FLOOD})
             for name in stage.bridges}
    for side in sides.values():
        _connect(stage, counter, side.node, topics)
        _first_messages(stage, side)

    def measure(side: Side) -> Figures:
        _settled(counter)
        cost, sent = _cost([side.child], lambda: side.talkers['arduino'].ask(
            'flood', baud=_FLOOD, seconds=plan.seconds))
        arrived = sum(count for topic, count in _settled(counter).items()
                      if topic.startswith(side.node))
        return {'bytes lost at the port': sent['lost'], **cost,
                'messages lost': len(topics) * sent['turns'] - arrived}

    return _in_turn(plan, {name: lambda side=side: measure(side) for name, side in sides.items()})


def _settled(counter: Servant) -> Dict[str, int]:
    """Return the number of messages by topic, once no more arrive."""
    total: Dict[str, int] = {}
    while True:
        counts = counter.ask('take')
        total = {topic: total.get(topic, 0) + count for topic, count in counts.items()}
        if not any(counts.values()):
            return total
        time.sleep(_SETTLE)


# -- the bus --------------------------------------------------------------------------------------

def bus(stage: BenchStage, plan: Plan) -> Results:
    """The gap from a reply's last byte to the next request's first while other calls wait."""
    sides = {name: stage.side(name, ('bus',), {'bus/environment_period': 0.0})
             for name in stage.bridges}
    caller = stage.servant('nodes', 'caller')
    for side in sides.values():
        caller.ask('ready', node=side.node, callers=_CALLERS)

    def measure(side: Side) -> Figures:
        figures: Figures = {}
        for service in ('get_environment', 'bus/echo'):
            side.others['bus'].ask('take')
            calls = caller.ask('call', service=f'{side.node}/{service}', seconds=plan.seconds / 2)
            gaps = gaps_in_queue(side.others['bus'].ask('take'), calls, _IN_QUEUE)
            trips = [end - start for start, end, _ in calls]
            figures.update({f'{service}: gap p50, ms': _figure(median, gaps),
                            f'{service}: call p50, ms': _figure(median, trips),
                            f'{service}: failed': sum(not success for *_, success in calls)})
        return figures

    return _in_turn(plan, {name: lambda side=side: measure(side) for name, side in sides.items()})


# -- settings -------------------------------------------------------------------------------------

def settings(stage: BenchStage, plan: Plan) -> Results:
    """From a set to its confirmation; heartbeats while a slider is dragged, or nothing changes."""
    side = stage.side('bridge', ('arduino',), {'arduino/settings': json.dumps(
        {'gain': {'setting': 1, 'layout': '<f'}})})
    caller, listener = stage.servant('nodes', 'caller'), side.others['listener']
    service = f'{side.node}/settings/arduino/set_parameters'
    caller.ask('set', service=service, seconds=0.0, pause=0.0)

    def measure(work: Callable[[], List[float]]) -> Figures:
        time.sleep(_SETTLE)
        listener.ask('take'), listener.ask('others')
        side.begin_talking(plan.seconds)     # a silent board gets no settings
        began, times = time.monotonic(), work()
        side.end_talking()
        seconds, beats = time.monotonic() - began, listener.ask('take')
        gaps = [after - then for then, after in zip(beats, beats[1:])]
        return {**({'p50, ms': _figure(median, times),
                    'p99, ms': _figure(lambda values: percentile(values, 99), times)}
                   if times else {}),
                'bytes a second besides heartbeats': listener.ask('others') / seconds,
                'heartbeat: p99.9, ms': _figure(lambda values: percentile(values, 99.9), gaps),
                'heartbeat: longest, ms': _figure(max, gaps)}

    def setting(pause: float) -> Measure:
        return lambda: measure(lambda: caller.ask('set', service=service, seconds=plan.seconds,
                                                  pause=pause))

    def nothing() -> List[float]:
        time.sleep(plan.seconds)
        return []

    return _in_turn(plan, {'5 sets a second': setting(0.2), 'a slider is dragged': setting(0.0),
                           'nothing changes': lambda: measure(nothing)})


SECTIONS = {section.__name__: section for section in (
    latency, busy, stamps, nano, cpu, bus, settings, flood, bridges)}
