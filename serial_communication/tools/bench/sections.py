"""What the bench measures: one function a section, each in turns, A B A B …

Two sides of a comparison are up at the same time, and one of them at a time is talked to, for a
few seconds, again and again: whatever else the machine does meets both.
"""
import statistics
import time
from typing import Any, Callable, Dict, List, NamedTuple

from .boards import BITS, COUNTED, TURNS
from .nodes import ENVIRONMENT_EVERY, NODE, POLLS
from .decoders import run as run_decoders
from .report import match, over_turns, queue_gaps
from .stage import Child, Stage, wait_for

RATES = {'arduino': 100.0, 'mcu': 20.0}           # turns a second, as the boards have it
_OF_LINK = {'arduino': ('imu', 'ticks', 'steering_angle', 'voltage'), 'mcu': ('status',),
            'bus': ('environment',)}
_THINKING = 0.005      # s that the bus board takes at most, so that no poller is in phase
_SETTLE = 0.2          # s for what is under way to arrive
_CALLERS = 8
_IN_QUEUE = 0.002      # s after which a call surely stands in the node's queue


class Plan(NamedTuple):
    """How long."""

    seconds: float     # a turn
    turns: int
    short: bool


def _warm_up(subscriber: Child, namespace: str, load: Callable[[], Any]) -> None:
    """Load a node until something has come on each of its topics."""
    def silent():
        load()
        return subscriber.ask('silent', namespace=namespace)

    wait_for(silent, 'warming up')


# -- 1, 2: against the polling reference ------------------------------------------------------

class _Pair:
    """The bridge and the reference, each with boards of its own, one subscriber for both."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.boards = {side: stage.boards() for side in ('bridge', 'reference')}
        ports = self.boards['bridge'].ports
        self.nodes = [
            stage.bridge('/bridge', ports, bus__environment_period=ENVIRONMENT_EVERY / POLLS),
            stage.child('reference', 'nodes', 'reference',
                        *['%s=%s' % port for port in self.boards['reference'].ports.items()],
                        namespace='/reference')]
        self.subscriber = stage.child('subscriber', 'nodes', 'subscriber', '/bridge',
                                      '/reference')
        wait_for(lambda: self.subscriber.ask('missing'), 'latency')
        for side, boards in self.boards.items():
            boards.bus.ask('pace', byte_time=0.0, delay=_THINKING)
            _warm_up(self.subscriber, '/' + side, lambda: boards.talk(RATES, 0.5))

    def turns(self, number: int):
        """(turn, side) in turns; the second side goes first every other time."""
        for turn in range(number):
            self.stage.check(*self.nodes)
            sides = ('bridge', 'reference')
            for side in sides if turn % 2 == 0 else reversed(sides):
                yield turn, side


def latency(stage: Stage, plan: Plan) -> Dict[str, Any]:
    """From the board's write to the subscriber's callback, of each link."""
    pair = _Pair(stage)
    links: Dict[str, Any] = {link: {side: [] for side in pair.boards} for link in _OF_LINK}
    missing = {link: dict.fromkeys(pair.boards, 0) for link in _OF_LINK}
    for _, side in pair.turns(plan.turns):
        boards = pair.boards[side]
        boards.bus.ask('begin')
        pair.subscriber.ask('begin')
        sent = boards.talk(RATES, plan.seconds)
        exchanges = boards.bus.ask('collect')
        time.sleep(_SETTLE)
        received = pair.subscriber.ask('collect', namespace='/' + side)
        sent['environment'] = [(number, written) for number, _, written, _ in exchanges]
        for link, names in _OF_LINK.items():
            turn: List[float] = []
            for name in names:
                latencies, unmatched = match(sent[name], received[name], COUNTED[name])
                turn += latencies
                missing[link][side] += unmatched
            links[link][side].append(turn)
    return {'links': {link: {side: dict(over_turns(turns), unmatched=missing[link][side])
                             for side, turns in sides.items()}
                      for link, sides in links.items()}}


def heartbeat(stage: Stage, plan: Plan) -> Dict[str, Any]:
    """The interval between heartbeats, idle and with two busy processes."""
    pair = _Pair(stage)
    timer = stage.child('timer', 'boards', 'timer')
    result = {}
    for name, seconds in (('idle', plan.seconds), ('busy', 2 * plan.seconds)):
        busy = [stage.busy() for _ in range(2 if name == 'busy' else 0)]
        intervals: Dict[str, List[List[float]]] = {
            side: [] for side in ('bridge', 'reference', 'bare timer')}
        for _, side in pair.turns(max(1, 2 * plan.turns // 3)):
            boards = pair.boards[side]
            sources = ((side, boards.listener), ('bare timer', timer))
            for _, source in sources:
                source.ask('begin')
            boards.talk(RATES, seconds)
            for key, source in sources:
                stamps = source.ask('collect')
                intervals[key].append([b - a for a, b in zip(stamps, stamps[1:])])
        stage.end(*busy)
        result[name] = {side: over_turns(turns) for side, turns in intervals.items()}
    return result


# -- 3: against what rospy takes ----------------------------------------------------------------

def cpu(stage: Stage, plan: Plan) -> Dict[str, Any]:
    """User and system time of the node, with subscribers and without, and of the floor."""
    boards = {name: stage.boards() for name in ('bridge', 'no subscriber')}
    nodes = {'bridge': stage.bridge('/bridge', boards['bridge'].ports),
             'no subscriber': stage.bridge('/quiet', boards['no subscriber'].ports),
             'floor': stage.child('floor', 'nodes', 'floor', namespace='/floor')}
    subscriber = stage.child('subscriber', 'nodes', 'subscriber', '/bridge', '/floor')
    wait_for(lambda: subscriber.ask('missing'), 'cpu')

    def load(name: str, seconds: float) -> None:
        if name == 'floor':
            nodes[name].ask('publish', seconds=seconds)
        else:
            boards[name].talk(RATES, seconds)

    _warm_up(subscriber, '/bridge', lambda: load('bridge', 0.5))
    _warm_up(subscriber, '/floor', lambda: load('floor', 1.0))
    load('no subscriber', 0.5)
    turns: Dict[str, List[float]] = {name: [] for name in nodes}
    messages = dict.fromkeys(nodes, 0.0)
    order = list(nodes)
    number = max(2, 2 * plan.turns // 3)
    for turn in range(number):
        for name in order if turn % 2 == 0 else reversed(order):
            node = nodes[name]
            stage.check(node)
            subscriber.ask('begin')
            spent, start = node.cpu_seconds(), time.monotonic()
            load(name, plan.seconds)
            spent = node.cpu_seconds() - spent
            elapsed = time.monotonic() - start
            turns[name].append(100 * spent / elapsed)
            messages[name] += sum(subscriber.ask('counts').values()) / elapsed / number
    # What the other bridge says on /diagnostics meanwhile is no message of the quiet one.
    messages['no subscriber'] = 0.0
    return {name: {'CPU %': statistics.median(values), 'messages/s': messages[name],
                   'CPU % of each turn': ' '.join('%.2f' % value for value in values)}
            for name, values in turns.items()}


# -- 4: the bus ---------------------------------------------------------------------------------

def bus(stage: Stage, plan: Plan) -> Dict[str, Any]:
    """Round trips with several callers, at the wire's pace and without."""
    boards = stage.boards(('bus',))
    node = stage.bridge('/bridge', boards.ports, bus__environment_period=0.0)
    caller = stage.child('caller', 'nodes', 'caller', '/bridge')
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
    return {'callers': _CALLERS, 'rows': [_bus_row(wire, kind, measured[wire, kind])
                                          for wire, kind in cases]}


def _bus_row(wire: int, kind: str, turns: list) -> Dict[str, Any]:
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
    return {'wire': wire, 'callers': kind, 'requests/s': rate,
            'requests/s of the wire': 1 / of_wire if wire else None,
            'share of the wire %': 100 * rate * of_wire if wire else None,
            'gap, queue not empty': over_turns(gaps), 'gap, queue empty or unsure':
            over_turns(unsure), 'round trip': over_turns(trips),
            'to the answer': over_turns(answers), 'failed': failed}


# -- 5: the decoders ----------------------------------------------------------------------------

def decoders(_stage: Any, plan: Plan) -> Dict[str, Any]:
    """Bytes to typed messages, against a byte at a time."""
    return run_decoders(4.0 if plan.short else 8.0 * plan.seconds)


# -- 6: until something is lost -----------------------------------------------------------------

_TOPICS = {'arduino': ['imu', 'imu/temperature', 'ticks', 'steering_angle', 'voltage'],
           'mcu': ['status', 'imu', 'range_1', 'range_2']}


def scale(stage: Stage, plan: Plan) -> Dict[str, Any]:
    """Packets back to back at ever higher rates: what is published, at what cost, what is lost."""
    if plan.short:
        cases = [('arduino', baud, 1.0) for baud in (115200, 1000000, 3000000)]
    else:
        turn = sum(len(packet) for _, packet in TURNS['arduino'](1)) * BITS
        cases = [('arduino', 115200, rate * turn / 115200) for rate in (25, 100)]
        cases += [('arduino', baud, 1.0)
                  for baud in (115200, 230400, 460800, 1000000, 2000000, 3000000)]
        cases += [('mcu', baud, 1.0) for baud in (115200, 460800, 1000000, 3000000)]
    rows = []
    for link, baud, load in cases:
        rows.append(_scale_row(stage, link, baud, load, plan.seconds))
        stage.clear()
    return {'rows': rows}


def _scale_row(stage: Stage, link: str, baud: int, load: float,
               seconds: float) -> Dict[str, Any]:
    boards = stage.boards((link,))
    node = stage.bridge('/bridge', boards.ports, **{link + '__baud': baud})
    counter = stage.child('counter', 'counter')
    prefix = '/bridge/mcu/' if link == 'mcu' else '/bridge/%s/' % NODE
    topics = [prefix + name for name in _TOPICS[link]]
    wait_for(lambda: counter.ask('connect', node='/bridge/' + NODE,
                                 topics=['/bridge/diagnostics']), 'scale')
    counter.ask('connect', node='/bridge/' + NODE, topics=topics)
    wait_for(lambda: counter.ask('waiting'), 'scale')
    wait_for(lambda: not counter.ask('diagnostics') and 'the first diagnostics', 'scale')
    counter.ask('begin')
    spent = node.cpu_seconds()
    sent = boards.talkers[link].ask('flood', rate=baud / BITS * load, seconds=seconds)
    counts = _settled(counter, topics)
    spent = node.cpu_seconds() - spent
    memory = node.memory()
    time.sleep(1.1)      # until the node has said how many frames it has
    stage.check(node)
    said = _diagnostics(counter, link)
    packets = sent['packets']
    # Of the car's four packets the first makes two messages, the others one each.
    dues = ([(packets + 3 - n) // 4 for n in (0, 0, 1, 2, 3)] if link == 'arduino'
            else [packets] * len(topics))
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
    return {'link': link, 'baud': baud, 'load %': 100 * load, 'frames sent': packets,
            'frames': frames, 'frames/s': frames / sent['seconds'],
            'bytes': sent['bytes'], 'bytes lost': sent['lost'],
            'messages': published, 'messages due': due, 'messages/s': published / sent['seconds'],
            'CPU %': 100 * spent / sent['seconds'],
            'us/message': spent / published * 1e6 if published else None,
            'memory': memory, 'first lost': first,
            'errors': {key: value for key, value in said.items()
                       if key.endswith('errors') and value != '0'}}


def _settled(counter: Child, topics: List[str]) -> Dict[str, int]:
    """The counts once they stand still."""
    before: Dict[str, int] = {}
    for _ in range(100):
        counts = counter.ask('collect')
        if all(counts[topic] == before.get(topic) for topic in topics):
            break
        before = counts
        time.sleep(_SETTLE)
    return counts


def _diagnostics(counter: Child, link: str) -> Dict[str, str]:
    for name, values in counter.ask('diagnostics').items():
        if name.endswith('%s link' % link):
            return values
    return {'frames received': '0'}


SECTIONS = {'latency': latency, 'heartbeat': heartbeat, 'cpu': cpu, 'bus': bus,
            'decoders': decoders, 'scale': scale}
