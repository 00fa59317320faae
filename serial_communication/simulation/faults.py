"""Faults on demand, for tests: those of the line, in both directions, and those of the board.

A fault is written KIND=RATE[:SECONDS], as flip=0.01 or silence=2/min:0.5-2. RATE is a probability
for each frame that the board sends, or a number of events per minute. With rx- before it, as in
rx-flip=0.01, damage is done to what the board receives in one read. SECONDS, for the kinds with a
duration, is a number or a range. drift=PPM and batch=MS are a number, in force all the time. `all`
stands for the board's default mix, which later faults change.

The same seed repeats a run: each kind has random numbers of its own.
"""
import re
from random import Random
from typing import Dict, List, NamedTuple, Optional, Protocol, Tuple

_PPM, _MS, _EVENT = 'ppm', 'ms', '/min'


class Kind(NamedTuple):
    """One kind of fault."""

    text: str                                 # what it does, for --help
    unit: str = ''                            # of its number; '': a probability
    most: float = 1.0                         # the greatest number
    seconds: Tuple[float, float] = (0, 0)     # default duration; (0, 0): it has none


DAMAGE = {
    'drop': Kind('a frame is lost'),
    'cut': Kind('the end of a frame is lost'),
    'lose': Kind('one to three bytes of a frame are lost'),
    'flip': Kind('one bit of a frame is flipped'),
    'insert': Kind('one to three bytes are inserted in, before or after a frame'),
    'double': Kind('a frame comes twice, in one piece'),
}
KINDS = {
    **DAMAGE,
    **{'rx-' + name: Kind('the same of a read: ' + kind.text.replace('a frame', 'what is read'))
       for name, kind in DAMAGE.items()},
    'delay': Kind('a frame and all frames behind it are delayed', seconds=(0.02, 0.2)),
    'silence': Kind('nothing that the board sends gets out', _EVENT, 600, (0.5, 2.0)),
    'stall': Kind('the board reads nothing, and the buffers fill up', _EVENT, 600, (0.3, 2.0)),
    'reset': Kind('the board sends noise, restarts, loses its memory', _EVENT, 600, (0.3, 1.0)),
    'drift': Kind('the board sends its time; its clock is so many ppm too fast', _PPM, 9999),
    'batch': Kind('an adapter delivers what the board sends only every so many ms', _MS, 1000),
}
_FAULT = re.compile(r'([a-z-]+)=(-?\d*\.?\d+)(/min)?(?::(\d*\.?\d+)(?:-(\d*\.?\d+))?)?$')


class Rate(NamedTuple):
    """How often a kind of fault happens, or its number, and how long it lasts."""

    number: float
    seconds: Tuple[float, float]     # the shortest and the longest duration


class Target(Protocol):
    """The attributes of a board that decide which faults it can have."""

    FAULTS: str        # the faults of `all`
    READS: bool        # False: it hardly reads, so nothing that it receives is damaged
    HAS_CLOCK: bool    # False: it never sends its time


def parse(text: str, board: Optional[Target] = None) -> Dict[str, Rate]:
    """Rates by kind, from the argument of ``--faults``; 'none': no faults.

    Faults that this board cannot have are left out: a launch file gives all boards the same.

    Raises:
        ValueError: there is no such fault, or its number is wrong.
    """
    rates: Dict[str, Rate] = {}
    for each in text.split():
        if each in ('all', 'none'):
            rates.update(parse(board.FAULTS, board) if board and each == 'all' else {})
        else:
            name, rate = _parse_one(each)
            if board is None or fits(name, board):
                rates[name] = rate
    return rates


def fits(name: str, board: Target) -> bool:
    """Whether the board can have this kind of fault."""
    if name == 'drift':
        return board.HAS_CLOCK
    return board.READS or name != 'stall' and not name.startswith('rx-')


def _parse_one(text: str) -> Tuple[str, Rate]:
    match = _FAULT.match(text)
    if not match or match.group(2) < '.' and match.group(1) != 'drift':     # '-'
        raise ValueError(f'fault {text!r} is not "all" or KIND=RATE[:SECONDS], as flip=0.01 or '
                         'silence=2/min:0.5-2')
    name, number, per_minute, low, high = match.groups()
    kind = KINDS.get(name)
    if kind is None:
        raise ValueError(f'there is no fault {name!r}, only {", ".join(KINDS)}')
    if bool(per_minute) != (kind.unit == _EVENT) or abs(float(number)) > kind.most:
        what = f'a number up to {kind.most:g} {kind.unit}' if kind.unit in (_PPM, _MS) else \
            f'a rate up to {kind.most:g} per minute: {name}=1/min' if kind.unit else \
            f'a probability is 0 to 1, not {number}{per_minute or ""}'
        raise ValueError(f'fault {name!r}: {what}')
    if low and kind.seconds == (0, 0):
        raise ValueError(f'fault {name!r} has no duration: leave out the seconds')
    seconds = (float(low), float(high or low)) if low else kind.seconds
    if seconds[1] < seconds[0]:
        raise ValueError(f'fault {name!r}: the range {low}-{high} s is empty')
    return name, Rate(float(number), seconds)


class Faults:
    """The faults of one board; none without rates."""

    def __init__(self, rates: Optional[Dict[str, Rate]] = None, seed: int = 0) -> None:
        self._rates = rates or {}
        self._random = {name: Random(f'{seed} {name}') for name in self._rates}
        self._due: Dict[str, float] = {}         # when each event happens next
        self.counts: Dict[str, int] = {}
        numbers = {name: rate.number for name, rate in self._rates.items()}
        self.drift: Optional[float] = numbers.get('drift')    # ppm; None: the board sends no time
        self.batch = numbers.get('batch', 0.0) * 1e-3         # s; 0.0: nothing is held back

    def start(self, now: float) -> None:
        """Begin to count the time of the events."""
        self._due = {name: now + self._pause(name) for name, rate in self._rates.items()
                     if KINDS[name].unit == _EVENT and rate.number}

    def damaged(self, data: bytes, direction: str = '') -> bytes:
        """What is left of a frame, or with the direction 'rx-' of one read."""
        for name in DAMAGE:
            if self._happens(direction + name):
                return _damage(name, data, self._random[direction + name])
        return data

    def delay(self) -> float:
        """s by which the next frame is delayed."""
        return self._seconds('delay') if self._happens('delay') else 0.0

    def events(self, now: float) -> List[Tuple[str, float]]:
        """The events that begin now: (kind, duration in s)."""
        begun = [name for name, due in self._due.items() if now >= due]
        for name in begun:
            self._due[name] += self._pause(name)
            self._count(name)
        return [(name, self._seconds(name)) for name in begun]

    def next_event(self) -> Optional[float]:
        """When to call `events` next; None: never."""
        return min(self._due.values(), default=None)

    def _happens(self, name: str) -> bool:
        if name not in self._rates or self._random[name].random() >= self._rates[name].number:
            return False
        self._count(name)
        return True

    def _pause(self, name: str) -> float:
        return self._random[name].expovariate(self._rates[name].number / 60)

    def _seconds(self, name: str) -> float:
        return self._random[name].uniform(*self._rates[name].seconds)

    def _count(self, name: str) -> None:
        self.counts[name] = self.counts.get(name, 0) + 1


def _damage(name: str, data: bytes, random: Random) -> bytes:
    """`data` changed by a fault; the result always differs from it."""
    size, count = len(data), random.randint(1, 3)
    if name == 'drop':
        return b''
    if name == 'cut':
        return data[:random.randrange(1, size)] if size > 1 else b''
    if name == 'double':
        return data + data
    if name == 'flip':
        at = random.randrange(size)
        return data[:at] + bytes((data[at] ^ 1 << random.randrange(8),)) + data[at + 1:]
    if name == 'lose':
        at = random.randrange(max(size - count, 0) + 1)
        return data[:at] + data[at + count:]
    at = random.randint(0, size)
    return data[:at] + bytes(random.randrange(256) for _ in range(count)) + data[at:]
