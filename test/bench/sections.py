"""What the bench measures: one function a section, each in turns, A B A B …

Two sides of a comparison are up at the same time and alternate every few seconds, so background
load affects them equally.
"""
import statistics
import time
from typing import Any, Callable, Dict, List, NamedTuple, Sequence, Tuple

from processes import NODE, Child
from serial_communication.tools.watch.topics import resolve
from .boards import BITS, COUNTED, LINKS, TURNS, measured_topics
from .decoders import run as run_decoders
from .figures import BusCalls, Bridges, Cpu, Decoding, Heartbeat, Latency, Load, RowCost
from .nodes import ENVIRONMENT_EVERY, POLLS
from .report import match, over_turns, queue_gaps
from .rows import run as run_rows
from .stage import BenchStage, Servant, memory

RATES = {'arduino': 100.0, 'mcu': 20.0}           # turns a second, as the boards have it
_THINKING = 0.005      # s that the bus board takes at most, so that no poller is in phase
_SETTLE = 0.2          # s for what is under way to arrive
_CALLERS = 8
_IN_QUEUE = 0.002      # s after which a call surely stands in the node's queue


class Plan(NamedTuple):
    """How long."""

    seconds: float     # a turn
    turns: int
    short: bool


def _connected(stage: BenchStage, subscriber: Servant) -> None:
    stage.wait(lambda: not subscriber.ask('missing'), 'every topic is connected')


def _warm_up(stage: BenchStage, subscriber: Servant, namespace: str,
             load: Callable[[], Any]) -> None:
    """Load a node until something has come on each of its topics."""
    def speaks():
        load()
        return not subscriber.ask('silent', namespace=namespace)

    stage.wait(speaks, f'something comes on every topic of {namespace}')


# -- 1, 2: against the polling reference ------------------------------------------------------

class _Pair:
    """The bridge and the reference, each with boards of its own, one subscriber for both."""

    def __init__(self, stage: BenchStage) -> None:
        self.stage = stage
        self.boards = {side: stage.boards() for side in ('bridge', 'reference')}
        self.nodes = [
            stage.bridge(self.boards['bridge'].ports, {
                'bus/environment_period': ENVIRONMENT_EVERY / POLLS}, namespace='/bridge'),
            stage.servant('reference', 'nodes', 'reference',
                          *[f'{link}={port}' for link, port in
                            self.boards['reference'].ports.items()], namespace='/reference')]
        self.subscriber = stage.servant('subscriber', 'nodes', 'subscriber', '/bridge',
                                        '/reference')
        _connected(stage, self.subscriber)
        for side, boards in self.boards.items():
            boards.bus.ask('pace', byte_time=0.0, delay=_THINKING)
            _warm_up(stage, self.subscriber, '/' + side, lambda: boards.talk(RATES, 0.5))

    def turns(self, number: int):
        """The side whose turn it is; the second side goes first every other time."""
        for turn in range(number):
            self.stage.check(*self.nodes)
            sides = ('bridge', 'reference')
            yield from sides if turn % 2 == 0 else reversed(sides)


def latency(stage: BenchStage, plan: Plan) -> List[Latency]:
    """From the board's write to the subscriber's callback, of each link."""
    pair = _Pair(stage)
    measured: Dict[Tuple[str, str], List[List[float]]] = {
        (link, side): [] for link in LINKS for side in pair.boards}
    missing = dict.fromkeys(measured, 0)
    for side in pair.turns(plan.turns):
        boards = pair.boards[side]
        boards.bus.ask('begin')
        pair.subscriber.ask('begin')
        sent = boards.talk(RATES, plan.seconds)
        exchanges = boards.bus.ask('collect')
        time.sleep(_SETTLE)
        received = pair.subscriber.ask('collect', namespace='/' + side)
        sent['~environment'] = [(number, written) for number, _, written, _ in exchanges]
        for link in LINKS:
            turn: List[float] = []
            for name in [topic.name for topic in measured_topics(link) if topic.name in COUNTED]:
                latencies, unmatched = match(sent[name], received[name], COUNTED[name])
                turn += latencies
                missing[link, side] += unmatched
            measured[link, side].append(turn)
    return [Latency(link, side, over_turns(turns), missing[link, side])
            for (link, side), turns in measured.items()]


def heartbeat(stage: BenchStage, plan: Plan) -> List[Heartbeat]:
    """The interval between heartbeats, idle and with two busy processes."""
    pair = _Pair(stage)
    timer = stage.servant('timer', 'boards', 'timer')
    rows = []
    for load, seconds in (('idle', plan.seconds), ('busy', 2 * plan.seconds)):
        busy = stage.busy(2 if load == 'busy' else 0)
        intervals: Dict[str, List[List[float]]] = {
            side: [] for side in ('bridge', 'reference', 'bare timer')}
        for side in pair.turns(max(1, 2 * plan.turns // 3)):
            boards = pair.boards[side]
            sources = ((side, boards.listener), ('bare timer', timer))
            for _, source in sources:
                source.ask('begin')
            boards.talk(RATES, seconds)
            for key, source in sources:
                stamps = source.ask('collect')
                intervals[key].append([b - a for a, b in zip(stamps, stamps[1:])])
        for child in busy:
            stage.end(child)
        rows += [Heartbeat(load, side, over_turns(turns)) for side, turns in intervals.items()]
    return rows


# -- 3: against what rospy takes ----------------------------------------------------------------

def cpu(stage: BenchStage, plan: Plan) -> List[Cpu]:
    """User and system time of the node, with subscribers and without, and of the floor."""
    boards = {name: stage.boards() for name in ('bridge', 'no subscriber')}
    nodes = {'bridge': stage.bridge(boards['bridge'].ports, {}, namespace='/bridge'),
             'no subscriber': stage.bridge(boards['no subscriber'].ports, {}, 'quiet bridge',
                                           namespace='/quiet'),
             'floor': stage.servant('floor', 'nodes', 'floor', namespace='/floor')}
    subscriber = stage.servant('subscriber', 'nodes', 'subscriber', '/bridge', '/floor')
    _connected(stage, subscriber)

    def load(name: str, seconds: float) -> None:
        if name == 'floor':
            nodes[name].ask('publish', seconds=seconds)
        else:
            boards[name].talk(RATES, seconds)

    _warm_up(stage, subscriber, '/bridge', lambda: load('bridge', 0.5))
    _warm_up(stage, subscriber, '/floor', lambda: load('floor', 1.0))
    load('no subscriber', 0.5)
    turns: Dict[str, List[float]] = {name: [] for name in nodes}
    messages = dict.fromkeys(nodes, 0.0)
    order = list(nodes)
    number = max(2, 2 * plan.turns // 3)
    for turn in range(number):
        for name in order if turn % 2 == 0 else reversed(order):
            stage.check(nodes[name])
            subscriber.ask('begin')
            seconds, percent = _cost([nodes[name]], lambda: load(name, plan.seconds))
            turns[name].append(percent)
            messages[name] += sum(subscriber.ask('counts').values()) / seconds / number
    # What the other bridge says on /diagnostics meanwhile is no message of the quiet one.
    messages['no subscriber'] = 0.0
    return [Cpu(name, statistics.median(values), messages[name], values)
            for name, values in turns.items()]


def _cost(nodes: Sequence[Child], load: Callable[[], Any]) -> Tuple[float, float]:
    """How long the load took, in s, and what the nodes did meanwhile, in % of a core."""
    spent, start = sum(node.cpu_seconds() for node in nodes), time.monotonic()
    load()
    spent = sum(node.cpu_seconds() for node in nodes) - spent
    elapsed = time.monotonic() - start
    return elapsed, 100 * spent / elapsed


def bridges(stage: BenchStage, plan: Plan) -> List[Bridges]:
    """User and system time of one bridge, of four and of ten under one master."""
    rows = []
    for number in (1, 3) if plan.short else (1, 4, 10):
        rows.append(_bridges_row(stage, plan, number))
        stage.clear()
    return rows


def _bridges_row(stage: BenchStage, plan: Plan, number: int) -> Bridges:
    names = [f'/robot{index}' for index in range(number)]
    boards = [stage.boards() for _ in names]
    nodes = [stage.bridge(own.ports, {}, f'bridge {name}', namespace=name)
             for name, own in zip(names, boards)]
    counter = stage.servant('counter', 'counter')

    def load(seconds: float) -> None:
        for own in boards:
            own.start_talking(RATES, seconds)
        for own in boards:
            own.end_talking(RATES)

    for name in names:
        stage.wait(lambda: not counter.ask('connect', node=f'{name}/{NODE}',
                                           topics=_topics(name, *LINKS)),
                   f'the bridge {name} is up')
    stage.wait(lambda: not counter.ask('waiting'), 'every topic is connected')
    load(1.0)
    turns, messages = [], []
    for _ in range(max(2, plan.turns // 2)):
        stage.check(*nodes)
        counter.ask('begin')
        seconds, percent = _cost(nodes, lambda: load(plan.seconds))
        turns.append(percent)
        messages.append(sum(counter.ask('collect').values()) / seconds)
    percent = statistics.median(turns)
    return Bridges(number, percent, percent / number, statistics.median(messages), turns)


# -- 4: the bus ---------------------------------------------------------------------------------

def bus(stage: BenchStage, plan: Plan) -> List[BusCalls]:
    """Round trips with several callers, at the wire's pace and without."""
    boards = stage.boards(('bus',))
    node = stage.bridge(boards.ports, {'bus/environment_period': 0.0}, namespace='/bridge')
    caller = stage.servant('caller', 'nodes', 'caller', '/bridge')
    caller.ask('ready')
    cases = [(wire, kind) for wire in (115200, 0)
             for kind in ('environment', 'echo', 'raw', 'mixed')]
    turns, seconds = (1, plan.seconds / 2) if plan.short else (2, plan.seconds)
    measured: Dict[Any, list] = {case: [] for case in cases}
    for _ in range(turns):
        for wire, kind in cases:
            stage.check(node)
            boards.bus.ask('pace', byte_time=BITS / wire if wire else 0.0, delay=0.0)
            boards.bus.ask('begin')
            calls = caller.ask('call', kind=kind, callers=_CALLERS, seconds=seconds)
            measured[wire, kind].append((boards.bus.ask('collect'), calls))
    return [_bus_row(wire, kind, measured[wire, kind]) for wire, kind in cases]


def _bus_row(wire: int, kind: str, turns: list) -> BusCalls:
    gaps, unsure, trips, answers, rates, own = [], [], [], [], [], []
    failed = 0
    for exchanges, calls in turns:
        queue, other = queue_gaps(exchanges, calls, _IN_QUEUE)
        gaps.append(queue)
        unsure.append(other)
        trips.append([end - start for start, end, _ in calls])
        written = {number: at for number, _, at, _ in exchanges}
        answers.append([end - written[number] for _, end, number in calls
                        if number is not None and number in written])
        failed += sum(1 for call in calls if call[2] is None)
        elapsed = exchanges[-1][2] - exchanges[0][1]
        rates.append(len(exchanges) / elapsed)
        own.append(statistics.mean(size for _, _, _, size in exchanges) * BITS / 115200)
    rate, of_wire = statistics.median(rates), statistics.median(own)
    return BusCalls(wire, kind, rate, 1 / of_wire if wire else None,
                    100 * rate * of_wire if wire else None, over_turns(gaps), over_turns(unsure),
                    over_turns(trips), over_turns(answers), failed)


# -- 5: the decoders ----------------------------------------------------------------------------

def decoders(_stage: BenchStage, plan: Plan) -> List[Decoding]:
    """Bytes to typed messages, against a byte at a time."""
    return run_decoders(4.0 if plan.short else 8.0 * plan.seconds)


def rows(_stage: BenchStage, plan: Plan) -> List[RowCost]:
    """Messages that are rows, against a class of its own."""
    return run_rows(2.0 if plan.short else 4.0 * plan.seconds)


# -- 6: until something is lost -----------------------------------------------------------------

def _topics(namespace: str, *links: str) -> List[str]:
    """Of these links, with their whole names."""
    return [resolve(topic.name, f'{namespace}/{NODE}') for topic in measured_topics(*links)]


def _scale_cases(plan: Plan) -> List[Tuple[str, int, float]]:
    """(link, baud, share of the line that is used)."""
    if plan.short:
        return [('arduino', baud, 1.0) for baud in (115200, 1000000, 3000000)]
    turn = sum(len(packet) for _, packet in TURNS['arduino'](1)) * BITS
    cases = [('arduino', 115200, rate * turn / 115200) for rate in (25, 100)]
    cases += [('arduino', baud, 1.0)
              for baud in (115200, 230400, 460800, 1000000, 2000000, 3000000)]
    return cases + [('mcu', baud, 1.0) for baud in (115200, 460800, 1000000, 3000000)]


def scale(stage: BenchStage, plan: Plan) -> List[Load]:
    """Packets back to back at ever higher rates: what is published, at what cost, what is lost."""
    rows = []
    for link, baud, load in _scale_cases(plan):
        rows.append(_scale_row(stage, link, baud, load, plan.seconds))
        stage.clear()
    return rows


def _scale_row(stage: BenchStage, link: str, baud: int, load: float, seconds: float) -> Load:
    boards = stage.boards((link,))
    node = stage.bridge(boards.ports, {link + '/baud': baud}, namespace='/bridge')
    counter = stage.servant('counter', 'counter')
    topics = _topics('/bridge', link)
    stage.wait(lambda: not counter.ask('connect', node='/bridge/' + NODE,
                                       topics=['/bridge/diagnostics']), 'the bridge is up')
    counter.ask('connect', node='/bridge/' + NODE, topics=topics)
    stage.wait(lambda: not counter.ask('waiting'), 'every topic is connected')
    stage.wait(lambda: counter.ask('diagnostics'), 'the first diagnostics')
    counter.ask('begin')
    spent = node.cpu_seconds()
    sent = boards.talkers[link].ask('flood', rate=baud / BITS * load, seconds=seconds)
    counts = _settled(counter, topics)
    spent = node.cpu_seconds() - spent
    megabytes = memory(node)
    time.sleep(1.1)      # until the node has said how many frames it has
    stage.check(node)
    said = _diagnostics(counter, link)
    packets = sent['packets']
    # Each packet of a turn makes a message on its topic; the first makes those on the others, too.
    turn = [name for name, _ in TURNS[link](0)]
    dues = [(packets + len(turn) - 1 - (turn.index(name) if name in turn else 0)) // len(turn)
            for name in [topic.name for topic in measured_topics(link)]]
    # A silent sensor board's status is published, too: that one is not due.
    published = sum(min(counts[topic], due) for topic, due in zip(topics, dues))
    due = sum(dues)
    frames = int(said['frames received'])
    if link == 'mcu':
        frames -= int(said.get('frames doubled', 0))
    if sent['lost']:
        first = 'bytes at the port: it is not read in time'
    elif frames < packets:
        first = 'frames in decoding'
    elif published < due:
        first = "messages in rospy's queues"
    else:
        first = ''
    return Load(link, baud, 100 * load, packets, frames, frames / sent['seconds'], sent['bytes'],
                sent['lost'], published, due, published / sent['seconds'],
                100 * spent / sent['seconds'], spent / published * 1e6 if published else None,
                megabytes, first, {key: value for key, value in said.items()
                                   if key.endswith('errors') and value != '0'})


def _settled(counter: Servant, topics: List[str]) -> Dict[str, int]:
    """The counts once they stand still."""
    before: Dict[str, int] = {}
    for _ in range(100):
        counts = counter.ask('collect')
        if all(counts[topic] == before.get(topic) for topic in topics):
            break
        before = counts
        time.sleep(_SETTLE)
    return counts


def _diagnostics(counter: Servant, link: str) -> Dict[str, str]:
    for name, values in counter.ask('diagnostics').items():
        if name.endswith(f'{link} link'):
            return values
    return {'frames received': '0'}


class Section(NamedTuple):
    """One section, and about how long it takes."""

    run: Callable[[BenchStage, Plan], list]
    seconds: Callable[[Plan], float]


SECTIONS = {
    'latency': Section(latency, lambda p: 8 + 2 * p.turns * (p.seconds + _SETTLE)),
    'heartbeat': Section(heartbeat, lambda p: 8 + 4 * p.turns * p.seconds),
    'cpu': Section(cpu, lambda p: 8 + 2 * p.turns * p.seconds),
    'bridges': Section(bridges, lambda p: 25 + 1.5 * p.turns * p.seconds),
    'bus': Section(bus, lambda p: 5 + 16 * p.seconds),
    'decoders': Section(decoders, lambda p: 5 + 8 * p.seconds),
    'rows': Section(rows, lambda p: 2.0 if p.short else 4 * p.seconds),
    'scale': Section(scale, lambda p: len(_scale_cases(p)) * (p.seconds + 6)),
}
