"""When which fault of a campaign comes, as shares of a cycle. Pure: no clock, no processes.

Faults of one row of `IN_TURN` exclude each other: while one has its effect, the judge could not
tell whose fault it is that another is not borne. A fault lasts as long in a short cycle as in a
long one, so there is a shortest cycle, `LEAST`.
"""
import math
from typing import Dict, NamedTuple, Tuple

CYCLE = 60.0             # s; a campaign is divided into cycles of about that
STOPPED = 1.6            # s of SIGSTOP
FROZEN = 1.6             # s in which the arduino reads nothing
CALIBRATION = 3.0        # s that the board takes for a calibration
NETWORK_FROZEN = 4.0     # s
QUIET = 2.5              # s at the end of a cycle, and of all, in which every port stays
CUTS = 0.15, 0.5, 1.2    # s of the arduino's absences, each up to `LONGER` times that
LONGER = 1.2
_CALIBRATED = 1.0        # s that the bridge takes at most to see that a calibration is over …
_NOT_SEEN = 6.0          # … and where it saw too little of it, since the port was gone meanwhile
_NETWORK_RETURN = 3.0    # s that it may take for a network's return
_APART = 0.5             # s from the end of one fault to the next at least


class Turn(NamedTuple):
    """One fault: at which share of a cycle it begins, and the seconds until all is as before."""

    share: float
    seconds: float
    what: str


_CUT = tuple(LONGER * seconds for seconds in CUTS)
IN_TURN: Dict[str, Tuple[Turn, ...]] = {
    'arduino': (
        Turn(0.05, FROZEN, 'freeze'),
        Turn(0.30, CALIBRATION + _CALIBRATED, 'calibrate'),
        Turn(0.515, STOPPED, 'stop'),
        Turn(0.58, _CUT[0], 'cut'), Turn(0.63, _CUT[1], 'cut'), Turn(0.68, _CUT[2], 'cut'),
        Turn(0.73, FROZEN, 'freeze'),
        Turn(0.79, CALIBRATION + _NOT_SEEN, 'calibrate and cut')),
    'network': (
        Turn(0.15, NETWORK_FROZEN + _NETWORK_RETURN, 'freeze'),
        Turn(0.45, _NETWORK_RETURN, 'vanish'),
        Turn(0.70, NETWORK_FROZEN + _NETWORK_RETURN, 'freeze')),
}


def _least() -> float:
    """The shortest cycle, in whole seconds, in which each fault is over before the next one."""
    return math.ceil(max(
        max([(turns[-1].seconds + QUIET) / (1 - turns[-1].share)]
            + [(turn.seconds + _APART) / (after.share - turn.share)
               for turn, after in zip(turns, turns[1:])])
        for turns in IN_TURN.values()))


LEAST = _least()


def cycles(duration: float) -> Tuple[int, float]:
    """How many cycles fill a campaign, and the seconds of each: `LEAST` to twice `CYCLE`."""
    number = max(1, int(duration / CYCLE))
    return number, duration / number
