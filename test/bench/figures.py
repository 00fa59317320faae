"""What the bench's sections find, as records. Times in ms, CPU in % of a core."""
from typing import Dict, List, NamedTuple, Optional


class Spread(NamedTuple):
    """Of one measured time, over several turns; nan where nothing was measured."""

    p50: float           # median of the turns' own
    p99: float           # likewise
    p999: float          # of all turns together
    max: float
    deviation: float     # standard deviation: median of the turns' own
    count: int


class Latency(NamedTuple):
    """From a board's write to a subscriber's callback."""

    link: str
    node: str            # bridge or reference
    spread: Spread
    missing: int         # sent and never received


class Heartbeat(NamedTuple):
    """The interval between heartbeats, as the board sees it."""

    load: str            # idle, or busy: with two busy processes
    node: str            # bridge, reference or bare timer
    spread: Spread


class Cpu(NamedTuple):
    """User and system time of one node under the boards' usual traffic."""

    node: str            # bridge, no subscriber or floor
    percent: float       # median of the turns
    messages_per_s: float
    turns: List[float]   # % of each


class BusCalls(NamedTuple):
    """Calls of one kind by several callers at once."""

    wire: int                       # baud; 0: unpaced
    request: str
    requests_per_s: float
    wire_requests_per_s: Optional[float]    # that the wire could carry
    wire_percent: Optional[float]           # of its time
    gap: Spread                     # from a reply's last byte to the next request's first …
    gap_unsure: Spread              # … where the queue was empty, or may have been
    call: Spread                    # as the caller sees it
    to_answer: Spread               # from the reply's last byte to the caller's answer
    failed: int


class Speed(NamedTuple):
    """Of one decoder."""

    mb_per_s: float
    frames_per_s: float
    us_per_frame: Optional[float]
    frames: int


class Decoding(NamedTuple):
    """The package's decoder beside one that takes a byte at a time."""

    link: str
    stream: str
    reads: str                      # bytes of each, or "a frame"
    package: Speed
    bytewise: Speed
    times_as_fast: float
    at_best: Optional[float]        # if nothing but messages and records were built
    same_messages: bool


class RowCost(NamedTuple):
    """A message that is a row, and one that is a class of its own."""

    what: str
    us_decoded: float               # from bytes to the typed message
    us_to_ros: float                # … to the bytes of a ROS message
    times: float                    # that of a class of its own


class Load(NamedTuple):
    """Frames back to back."""

    link: str
    baud: int
    load_percent: float             # of the line
    frames_sent: int
    frames: int                     # that the node has counted
    frames_per_s: float
    bytes_sent: int
    bytes_lost: int                 # that the port did not take
    messages: int
    messages_due: int
    messages_per_s: float
    cpu_percent: float
    us_per_message: Optional[float]
    memory_mb: float
    first_lost: str                 # where; empty if nothing was
    errors: Dict[str, str]          # of the diagnostics


class Bridges(NamedTuple):
    """Several bridges under one master, each with three boards."""

    bridges: int
    percent: float                  # of all together, median of the turns
    percent_each: float
    messages_per_s: float           # of all together
    turns: List[float]


class GoalRow(NamedTuple):
    """A goal and what was measured for it."""

    what: str
    goal: str
    measured: float
    met: bool
    details: str
