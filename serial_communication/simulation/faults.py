"""Faults on demand, for rehearsing a bad day: seeded, so that a run can be repeated.

A fault is written KIND=RATE[:SECONDS]. RATE is a probability for each frame (0.01) or a number
of events a minute (2/min). SECONDS, for the kinds that last, is a number or a range (0.5-2).
``all`` is the board's own mix of the kinds that fit it; a later KIND=RATE changes one of it.

The n-th frame of two runs with one seed meets the same faults: each kind has random numbers of
its own and takes the same number of them for each frame. A frame is changed by one kind at most
(the first in `KINDS`' order); a delay may come on top.
"""
import re
from random import Random
from typing import Dict, Iterable, List, NamedTuple, Optional, Protocol, Tuple

SENT, RECEIVED, EVENT = 'sent', 'received', 'event'


class Kind(NamedTuple):
    """One kind of fault."""

    where: str                                     # SENT, RECEIVED or EVENT
    text: str                                      # what it does, for --help
    seconds: Optional[Tuple[float, float]] = None  # how long it lasts if nobody says


KINDS: Dict[str, Kind] = {
    'drop': Kind(SENT, 'a frame is lost as a whole'),
    'cut': Kind(SENT, 'a frame ends too early'),
    'lose': Kind(SENT, 'one to three bytes of a frame are lost'),
    'flip': Kind(SENT, 'one bit of a frame is flipped'),
    'insert': Kind(SENT, 'one to three bytes get into or around a frame'),
    'double': Kind(SENT, 'a frame is sent twice, in one write'),
    'repeat': Kind(SENT, 'a frame is sent again a little later, before all behind it',
                   (0.002, 0.03)),
    'delay': Kind(SENT, 'a frame is held back, and all behind it', (0.02, 0.2)),
    'late': Kind(SENT, 'the same for so long that a Master has given up', (0.6, 1.0)),
    'rx-drop': Kind(RECEIVED, 'what one read gives is lost before it reaches the board'),
    'rx-lose': Kind(RECEIVED, 'one to three bytes of it are lost'),
    'rx-flip': Kind(RECEIVED, 'one bit of it is flipped'),
    'rx-insert': Kind(RECEIVED, 'one to three bytes get into or around it'),
    'silence': Kind(EVENT, 'nothing of what the board sends leaves it', (0.5, 2.0)),
    'stall': Kind(EVENT, 'the board reads nothing, and the buffers fill up', (0.3, 2.0)),
    'reset': Kind(EVENT, 'the board restarts with a babble and has forgotten all', (0.3, 1.0)),
}

_RATE = re.compile(r'([a-z-]+)=(\d*\.?\d+)(/min)?(?::(\d*\.?\d+)(?:-(\d*\.?\d+))?)?$')


class Rate(NamedTuple):
    """How often a kind strikes: one of the two numbers is 0."""

    probability: float
    per_minute: float
    seconds: Tuple[float, float]

    def __str__(self) -> str:
        often = f'{self.per_minute:g}/min' if self.per_minute else f'{self.probability:g}'
        if self.seconds == (0.0, 0.0):
            return often
        return '{}:{:g}-{:g}'.format(often, *self.seconds)


class Target(Protocol):
    """What a board says of itself to whom faults are to happen."""

    NAME: str
    FAULTS: str    # its mix for ``all``
    READS: bool    # False: it never reads, so it cannot misread


def parse(texts: Iterable[str], board: Target) -> Dict[str, Rate]:
    """From what stands behind each ``--fault``.

    Raises:
        ValueError: no such fault, or one that makes no sense for this board; for a person.
    """
    rates: Dict[str, Rate] = {}
    for text in texts:
        for part in (board.FAULTS.split() if text == 'all' else [text]):
            kind, rate = _parse_one(part, board)
            if rate.probability or rate.per_minute:
                rates[kind] = rate
            else:
                rates.pop(kind, None)
    return rates


class EveryBoard:
    """The target of faults that are meant for every board."""

    NAME = 'every'
    FAULTS = ''
    READS = True


def for_every_board(text: str, board: Target) -> List[str]:
    """Of faults that are meant for every board, as 'flip=0.02 cut=0.01', those that fit this one;
    none of them for 'none' or an empty text.

    Raises:
        ValueError: as `parse`.
    """
    parts = [] if text == 'none' else text.split()
    parse(parts, EveryBoard)
    return [part for part in parts
            if part.split('=')[0] not in KINDS or fits(part.split('=')[0], board)]


def fits(name: str, board: Target) -> bool:
    """Whether that kind makes sense for this board: one that reads nothing cannot misread."""
    return board.READS or not (KINDS[name].where == RECEIVED or name == 'stall')


def _parse_one(text: str, board: Target) -> Tuple[str, Rate]:
    match = _RATE.match(text)
    if not match:
        raise ValueError(f'fault {text!r} is not "all" or KIND=RATE[:SECONDS], as flip=0.01 or '
                         'silence=2/min:0.5-2')
    name, number, per_minute, low, high = match.groups()
    kind = KINDS.get(name)
    if kind is None:
        raise ValueError(f'there is no fault {name!r}, only {", ".join(KINDS)}')
    if not fits(name, board):
        raise ValueError(f'fault {name!r}: the {board.NAME} board reads nothing anyway')
    amount = float(number)
    if kind.where == EVENT and not per_minute and amount:
        raise ValueError(f'fault {name!r} comes by the minute: write {name}={number}/min')
    if not per_minute and amount > 1:
        raise ValueError(f'fault {name!r}: a probability is 0 to 1, or write '
                         f'{name}={number}/min')
    if low and kind.seconds is None:
        raise ValueError(f'fault {name!r} lasts no time: leave the seconds out')
    seconds = kind.seconds or (0.0, 0.0)
    if low:
        seconds = (float(low), float(high or low))
        if seconds[1] < seconds[0]:
            raise ValueError(f'fault {name!r}: {low}-{high} is no range')
    return name, Rate(0.0 if per_minute else amount, amount if per_minute else 0.0, seconds)


class _Trigger:
    """When one kind strikes, and the numbers it needs then."""

    def __init__(self, name: str, rate: Rate, seed: int) -> None:
        self.name = name
        self.rate = rate
        self.details = Random(f'{seed} {name} details')
        self.due: Optional[float] = None     # of the next event, where it comes by the minute
        self._random = Random(f'{seed} {name}')

    def start(self, now: float) -> None:
        """The minutes count from here."""
        if self.rate.per_minute:
            self.due = now + self._gap()

    def strikes(self, now: float) -> bool:
        """To be asked once for each frame (or, for an event, at any time)."""
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


class Fate(NamedTuple):
    """What becomes of a frame."""

    wire: bytes              # what goes out; b'' if nothing does
    faults: Tuple[str, ...]  # what struck
    delay: float             # s
    repeat_after: float = 0.0    # s from then to a second time; 0: none


class Faults:
    """The faults of one board. Without rates nothing ever happens."""

    def __init__(self, rates: Optional[Dict[str, Rate]] = None, seed: int = 0) -> None:
        self.rates = rates or {}
        self.seed = seed
        self.counts: Dict[str, int] = {}
        triggers = [_Trigger(name, self.rates[name], seed) for name in KINDS if name in self.rates]
        self._sent = [t for t in triggers if KINDS[t.name].where == SENT]
        self._received = [t for t in triggers if KINDS[t.name].where == RECEIVED]
        self._events = [t for t in triggers if KINDS[t.name].where == EVENT]

    @property
    def on_input(self) -> bool:
        """Whether what a board receives may be changed."""
        return bool(self._received)

    def start(self, now: float) -> None:
        """The minutes count from here."""
        for trigger in self._sent + self._received + self._events:
            trigger.start(now)

    def sent(self, frame: bytes, now: float) -> Fate:
        """What becomes of a frame that the board sends."""
        wire, faults, delay, repeat_after = frame, [], 0.0, 0.0
        for trigger in self._sent:
            if not trigger.strikes(now):
                continue
            if trigger.name in ('delay', 'late'):
                delay = max(delay, trigger.seconds())
            elif wire is not frame:
                continue     # one change is enough
            elif trigger.name == 'repeat':
                repeat_after = trigger.seconds()
            else:
                wire = _change(trigger.name, frame, trigger.details)
            self._count(trigger.name)
            faults.append(trigger.name)
        return Fate(wire, tuple(faults), delay, repeat_after)

    def received(self, data: bytes, now: float) -> Tuple[bytes, List[str]]:
        """What one read gave: what the board gets of it, and what struck."""
        changed, faults = data, []
        for trigger in self._received:
            if trigger.strikes(now) and changed is data:
                changed = _change(trigger.name[3:], data, trigger.details)
                self._count(trigger.name)
                faults.append(trigger.name)
        return changed, faults

    def events(self, now: float) -> List[Tuple[str, float]]:
        """What begins now: (kind, seconds it lasts)."""
        begun = []
        for trigger in self._events:
            if trigger.strikes(now):
                self._count(trigger.name)
                begun.append((trigger.name, trigger.seconds()))
        return begun

    def next_event(self) -> Optional[float]:
        """When `events` has to be asked next."""
        return min((t.due for t in self._events if t.due is not None), default=None)

    def _count(self, name: str) -> None:
        self.counts[name] = self.counts.get(name, 0) + 1


def _change(name: str, frame: bytes, random: Random) -> bytes:
    """`frame` after that fault: other bytes than before, whatever it is."""
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
