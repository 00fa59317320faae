"""Faults on demand, for tests. They are seeded, so a run can be repeated.

A fault is written KIND=RATE[:SECONDS]. RATE is a probability for each frame (0.01) or a number
of events per minute (2/min). SECONDS, for the kinds with a duration, is a number or a range
(0.5-2). ``all`` stands for the board's default mix; a later KIND=RATE changes one of its kinds.
Two kinds are a number instead, in force all the time: drift=PPM and batch=MS.

In two runs with the same seed the n-th frame has the same faults: each kind has its own random
numbers, and uses the same number of them for each frame. At most one kind changes a frame (the
first in the order of `KINDS`), and it may be delayed as well.
"""
import re
from random import Random
from typing import Dict, Iterable, List, NamedTuple, Optional, Protocol, Tuple

SENT, RECEIVED, EVENT, ALWAYS = 'sent', 'received', 'event', 'always'


class Kind(NamedTuple):
    """One kind of fault."""

    where: str                                     # SENT, RECEIVED, EVENT or ALWAYS
    text: str                                      # what it does, for --help
    seconds: Optional[Tuple[float, float]] = None  # default duration; None: it has no duration


KINDS: Dict[str, Kind] = {
    'drop': Kind(SENT, 'a frame is lost'),
    'cut': Kind(SENT, 'the end of a frame is lost'),
    'lose': Kind(SENT, 'one to three bytes of a frame are lost'),
    'flip': Kind(SENT, 'one bit of a frame is flipped'),
    'insert': Kind(SENT, 'one to three bytes are inserted in, before or after a frame'),
    'double': Kind(SENT, 'a frame is sent twice, in one write'),
    'repeat': Kind(SENT, 'a frame is sent again later, before the next frame', (0.002, 0.03)),
    'delay': Kind(SENT, 'a frame and all frames behind it are delayed', (0.02, 0.2)),
    'late': Kind(SENT, 'the same, longer than a Master waits for a reply', (0.6, 1.0)),
    'rx-drop': Kind(RECEIVED, 'the bytes of one read are lost before the board gets them'),
    'rx-lose': Kind(RECEIVED, 'one to three bytes of a read are lost'),
    'rx-flip': Kind(RECEIVED, 'one bit of a read is flipped'),
    'rx-insert': Kind(RECEIVED, 'one to three bytes are inserted in, before or after a read'),
    'silence': Kind(EVENT, 'nothing that the board sends gets out', (0.5, 2.0)),
    'stall': Kind(EVENT, 'the board reads nothing, and the buffers fill up', (0.3, 2.0)),
    'reset': Kind(EVENT, 'the board sends noise, restarts and loses its memory', (0.3, 1.0)),
    'drift': Kind(ALWAYS, 'the board sends its time; its clock is so many ppm too fast'),
    'batch': Kind(ALWAYS, 'an adapter delivers what the board sends only every so many ms'),
}
_MOST = {'drift': (9999, 'ppm'), 'batch': (1000, 'ms')}     # the greatest number, and its unit

_RATE = re.compile(r'([a-z-]+)=(-?\d*\.?\d+)(/min)?(?::(\d*\.?\d+)(?:-(\d*\.?\d+))?)?$')


class Rate(NamedTuple):
    """How often a kind of fault happens; probability or per_minute is 0."""

    probability: float               # for each frame or read, 0 … 1
    per_minute: float
    seconds: Tuple[float, float]     # the shortest and the longest duration
    number: Optional[float] = None   # of a kind that is in force ALWAYS

    def __str__(self) -> str:
        if self.number is not None:
            return f'{self.number:g}'
        often = f'{self.per_minute:g}/min' if self.per_minute else f'{self.probability:g}'
        if self.seconds == (0.0, 0.0):
            return often
        return '{}:{:g}-{:g}'.format(often, *self.seconds)


class Target(Protocol):
    """The attributes of a board that decide which faults it can have."""

    NAME: str
    FAULTS: str    # the faults of ``all``
    READS: bool    # False: it never reads, so nothing that it receives can be changed
    HAS_CLOCK: bool    # False: it never sends its time


def parse(texts: Iterable[str], board: Target) -> Dict[str, Rate]:
    """Rates by kind, from the arguments of ``--fault``.

    Raises:
        ValueError: an unknown fault, or one that this board cannot have.
    """
    rates: Dict[str, Rate] = {}
    for text in texts:
        for part in (board.FAULTS.split() if text == 'all' else [text]):
            kind, rate = _parse_one(part, board)
            if rate.probability or rate.per_minute or rate.number is not None:
                rates[kind] = rate
            else:
                rates.pop(kind, None)
    return rates


class EveryBoard:
    """Stands for all boards when faults for every board are checked."""

    NAME = 'every'
    FAULTS = ''
    READS = True
    HAS_CLOCK = True


def for_every_board(text: str, board: Target) -> List[str]:
    """Those faults for every board that this one can have.

    Args:
        text: as 'flip=0.02 cut=0.01'; empty or 'none': no faults.

    Raises:
        ValueError: an unknown or invalid fault.
    """
    parts = [] if text == 'none' else text.split()
    parse(parts, EveryBoard)
    return [part for part in parts
            if part.split('=')[0] not in KINDS or fits(part.split('=')[0], board)]


def fits(name: str, board: Target) -> bool:
    """Whether the board can have this kind of fault: some need a board that reads, or sends its
    time."""
    if name == 'drift':
        return board.HAS_CLOCK
    return board.READS or not (KINDS[name].where == RECEIVED or name == 'stall')


def _parse_one(text: str, board: Target) -> Tuple[str, Rate]:
    match = _RATE.match(text)
    if not match or match.group(2) < '.' and match.group(1) != 'drift':     # '-'
        raise ValueError(f'fault {text!r} is not "all" or KIND=RATE[:SECONDS], as flip=0.01 or '
                         'silence=2/min:0.5-2')
    name, number, per_minute, low, high = match.groups()
    kind = KINDS.get(name)
    if kind is None:
        raise ValueError(f'there is no fault {name!r}, only {", ".join(KINDS)}')
    if not fits(name, board):
        raise ValueError(f'fault {name!r}: the {board.NAME} board '
                         + ('reads nothing anyway' if board.HAS_CLOCK else 'sends no time'))
    amount = float(number)
    if kind.where == ALWAYS:
        most, unit = _MOST[name]
        if per_minute or low or abs(amount) > most:
            raise ValueError(f'fault {name!r} is a number up to {most} {unit}: {name}=15')
        return name, Rate(0.0, 0.0, (0.0, 0.0), amount)
    if kind.where == EVENT and not per_minute and amount:
        raise ValueError(f'fault {name!r} needs a rate per minute: write {name}={number}/min')
    if not per_minute and amount > 1:
        raise ValueError(f'fault {name!r}: a probability is 0 to 1, not {number}; for a rate per '
                         f'minute write {name}={number}/min')
    if low and kind.seconds is None:
        raise ValueError(f'fault {name!r} has no duration: leave out the seconds')
    seconds = kind.seconds or (0.0, 0.0)
    if low:
        seconds = (float(low), float(high or low))
        if seconds[1] < seconds[0]:
            raise ValueError(f'fault {name!r}: the range {low}-{high} s is empty')
    return name, Rate(0.0 if per_minute else amount, amount if per_minute else 0.0, seconds)


class _Trigger:
    """Decides when one kind of fault happens, and has the random numbers for its details."""

    def __init__(self, name: str, rate: Rate, seed: int) -> None:
        self.name = name
        self.rate = rate
        self.details = Random(f'{seed} {name} details')
        self.due: Optional[float] = None     # when it happens next; None: it has a probability
        self._random = Random(f'{seed} {name}')

    def start(self, now: float) -> None:
        """Start the time of the rates per minute."""
        if self.rate.per_minute:
            self.due = now + self._gap()

    def happens(self, now: float) -> bool:
        """Whether it happens now; to be called once for each frame, or at any time for an event."""
        if self.due is None:
            return self._random.random() < self.rate.probability
        if now < self.due:
            return False
        self.due += self._gap()
        return True

    def seconds(self) -> float:
        return self.details.uniform(*self.rate.seconds)

    def _gap(self) -> float:
        return self._random.expovariate(self.rate.per_minute / 60)


class Transmission(NamedTuple):
    """How a frame is sent, after the faults."""

    wire: bytes              # the bytes to send; b'': none
    faults: Tuple[str, ...]  # the kinds that happened
    delay: float             # s
    repeat_after: float = 0.0    # s from then until it is sent again; 0: never


class Faults:
    """The faults of one board; none without rates."""

    def __init__(self, rates: Optional[Dict[str, Rate]] = None, seed: int = 0) -> None:
        self.rates = rates or {}
        self.seed = seed
        self.counts: Dict[str, int] = {}
        numbers = {name: rate.number for name, rate in self.rates.items()}
        self.drift: Optional[float] = numbers.get('drift')    # ppm; None: the board sends no time
        self.batch = (numbers.get('batch') or 0.0) * 1e-3     # s; 0.0: nothing is held back
        triggers = [_Trigger(name, self.rates[name], seed) for name in KINDS
                    if numbers.get(name, 0) is None]
        self._sent = [t for t in triggers if KINDS[t.name].where == SENT]
        self._received = [t for t in triggers if KINDS[t.name].where == RECEIVED]
        self._events = [t for t in triggers if KINDS[t.name].where == EVENT]

    @property
    def on_input(self) -> bool:
        """Whether bytes that the board receives may be changed."""
        return bool(self._received)

    def start(self, now: float) -> None:
        """Start the time of the rates per minute."""
        for trigger in self._sent + self._received + self._events:
            trigger.start(now)

    def sent(self, frame: bytes, now: float) -> Transmission:
        """How to send a frame of the board."""
        wire, faults, delay, repeat_after = frame, [], 0.0, 0.0
        for trigger in self._sent:
            if not trigger.happens(now):
                continue
            if trigger.name in ('delay', 'late'):
                delay = max(delay, trigger.seconds())
            elif wire is not frame:
                continue     # another kind has changed it
            elif trigger.name == 'repeat':
                repeat_after = trigger.seconds()
            else:
                wire = _change(trigger.name, frame, trigger.details)
            self._count(trigger.name)
            faults.append(trigger.name)
        return Transmission(wire, tuple(faults), delay, repeat_after)

    def received(self, data: bytes, now: float) -> Tuple[bytes, List[str]]:
        """The bytes that the board gets of one read, and the kinds of fault that happened."""
        changed, faults = data, []
        for trigger in self._received:
            if trigger.happens(now) and changed is data:
                changed = _change(trigger.name[3:], data, trigger.details)
                self._count(trigger.name)
                faults.append(trigger.name)
        return changed, faults

    def events(self, now: float) -> List[Tuple[str, float]]:
        """The events that begin now: (kind, duration in s)."""
        begun = []
        for trigger in self._events:
            if trigger.happens(now):
                self._count(trigger.name)
                begun.append((trigger.name, trigger.seconds()))
        return begun

    def next_event(self) -> Optional[float]:
        """When to call `events` next; None: never."""
        return min((t.due for t in self._events if t.due is not None), default=None)

    def _count(self, name: str) -> None:
        self.counts[name] = self.counts.get(name, 0) + 1


def _change(name: str, frame: bytes, random: Random) -> bytes:
    """`frame` changed by a fault; the result always differs from `frame`."""
    size = len(frame)
    if name == 'drop':
        return b''
    if name == 'cut':
        return frame[:random.randrange(1, size)] if size > 1 else b''
    if name == 'double':
        return frame + frame
    if name == 'flip':
        at = random.randrange(size)
        return frame[:at] + bytes((frame[at] ^ 1 << random.randrange(8),)) + frame[at + 1:]
    count = random.randint(1, 3)
    if name == 'lose':
        at = random.randrange(max(size - count, 0) + 1)
        return frame[:at] + frame[at + count:]
    if name == 'insert':
        at = random.randint(0, size)
        return frame[:at] + bytes(random.randrange(256) for _ in range(count)) + frame[at:]
    raise ValueError(name)
