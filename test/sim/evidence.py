"""What happened on a link, decoded by the definition of its protocol, never by the bridge."""
from bisect import bisect_right
from typing import Callable, Iterable, List, NamedTuple, Tuple

from by_definition import all_frames, arduino_at, decode, mcu_at, reply_at, request_at
from device import Chunk
from scenario import Story

Interval = Tuple[float, float]
FRAME_TIMEOUT = 0.05      # s


class At(NamedTuple):
    """A valid frame, and when its last byte was where it is."""

    time: float
    type: int
    number: int
    data: bytes
    begun: float        # when its first byte was there
    first: int          # its place among the bytes of its stream

    @property
    def content(self) -> Tuple[int, int, bytes]:
        """The frame without its time and place."""
        return self.type, self.number, self.data


class Evidence:
    """The frames of one story."""

    def __init__(self, story: Story) -> None:
        self.story = story
        self.kind, device = story.kind, story.device
        sent_at = request_at if self.kind == 'bus' else arduino_at \
            if self.kind == 'arduino' else mcu_at
        read_at = reply_at if self.kind == 'bus' else sent_at
        end = story.world.time if story.ended is None else story.ended
        self.openings: List[Interval] = []
        closings = iter(device.closings)
        # A port that is lent, and a connection in doubt, are given up: the thread closes them.
        given_up = [asked for asked, _, name, task in story.tasks
                    if name == 'lend' and task.answer[0]]
        given_up += device.flushes if device.kind == 'network' else []
        for opened in device.openings:
            # The bridge may not notice at once that the device is gone.
            gone = [begin for begin in given_up + [
                begin for begin, _ in self.events('unplugged', 'cut')] if begin >= opened]
            self.openings.append((opened, min([next(closings, end), end, *gone])))
        starts = [opened for opened, _ in self.openings]
        self.wrote = decoded(device.bridge_wrote, sent_at, starts)
        if self.kind != 'bus':      # a doubt begins with the next byte
            starts = sorted(starts + [each + 1e-9 for each in device.drops])
        self.read = decoded(device.bridge_read, read_at, starts)
        # Those that a decoder may find, whatever it gives up, and when.
        self.readable = decoded(device.bridge_read, read_at, starts, anywhere=True)
        self.got = decoded(device.board_gets, sent_at, [])
        self.sent = decoded(device.board_sent, read_at, [])     # by the board
        stops = self.events('stop')
        self.stops = stops + [  # the last one may not be released
            (begin, float('inf')) for begin in story.stopped_at[len(stops):]]
        calibrating = story.robot.calibrating       # as far as the bridge knows
        self.calibrations: List[Interval] = list(zip(
            [time for time, on in calibrating if on],
            [*(time for time, on in calibrating if not on), float('inf')]))
        self.suspended = list(story.world.suspensions)
        self.stalls = [merged(self.suspended + loop.stalls, 0.0) for loop in story.robot.loops]

    def events(self, *names: str) -> List[Interval]:
        """When these events were."""
        return [(event.begin, event.end) for event in self.story.events if event.name in names]

    def of_type(self, frames: Iterable[At], *types: int) -> List[At]:
        return [frame for frame in frames if frame.type in types]

    def opening_of(self, time: float) -> Interval:
        """The opening in which this time is; (inf, inf) while the port is closed."""
        return next((each for each in reversed(self.openings) if each[0] <= time <= each[1]),
                    (float('inf'), float('inf')))


def decoded(chunks: List[Chunk], frame_at: Callable, starts: List[float],
            anywhere: bool = False) -> List[At]:
    """The frames in these bytes; at each of `starts`, and after each silence, a new stream begins.

    Args:
        anywhere: also those that begin inside another one, or inside what is none.
    """
    frames: List[At] = []
    streams: List[List[Chunk]] = [[]]
    last, place = float('-inf'), 0
    for chunk in chunks:
        begins = bisect_right(starts, chunk.time) != bisect_right(starts, last)
        if begins or not anywhere and chunk.time - last > FRAME_TIMEOUT:
            streams.append([])
        streams[-1].append(chunk)
        last = chunk.time
    for stream in streams:
        ends, total = [], 0
        for chunk in stream:
            total += len(chunk.data)
            ends.append(total)
        data = b''.join(chunk.data for chunk in stream)
        for frame in all_frames(data, frame_at) if anywhere else decode(data, frame_at, True)[0]:
            frames.append(At(stream[bisect_right(ends, frame.end - 1)].time, frame.type,
                             frame.number, frame.data,
                             stream[bisect_right(ends, frame.start)].time, place + frame.start))
        place += total
    return frames


def overlaps(intervals: Iterable[Interval], begin: float, end: float, after: float = 0.0) -> bool:
    """Whether one of them, made longer by `after`, has a part between `begin` and `end`."""
    return any(low <= end and begin <= high + after for low, high in intervals)


def longer(intervals: Iterable[Interval], seconds: float) -> List[Interval]:
    """Those that last longer."""
    return [each for each in intervals if each[1] - each[0] > seconds]


def merged(intervals: Iterable[Interval], gap: float = 0.02) -> List[Interval]:
    """Those with hardly any time between them as one: the loop may not have run in it."""
    found: List[Interval] = []
    for begin, end in sorted(intervals):
        if found and begin <= found[-1][1] + gap:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((begin, end))
    return found
