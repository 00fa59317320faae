"""Statistics of a recording: frames, errors, gaps and load of each line.

A recording is a bag of serial_msg (rosbag record /serial_msg), with every link in it, or a file of
wire listen --raw or wire tap --raw. For each link and direction the output has the count, the rate
and the gaps of each type, the errors by cause, and the share of the wire's capacity; for the bus
also the round trips; for the arduino the gaps between heartbeats (one over 30 ms stops the motor);
for a board that sends its time the delay of the reads, from the measurement on, as far as it
varies. For an unknown link in a bag, types are shown as numbers.

  wire stats drive.bag
"""
import argparse
import json
from types import MappingProxyType
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple

from ...boards.description import Description, Numbering
from ...framing.board_time import MOST_DELAY, BoardClock
from ...framing.stream import FRAMING, Bad, StreamDecoder
from . import lines
from .figures import percentile
from .lines import Settings
from .recording import Recording, RecordedFrame, frames_of, learned_from, load
from .show import Paint, WireError, print_note

SUMMARY = 'show statistics of a recording: counts, gaps, errors, load, round trips'

_BITS_A_BYTE = 10        # a start bit, eight data bits, a stop bit
_MOST_SHARE = 1.05       # of the wire's capacity; the clocks of two sides differ a little


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire stats`."""
    parser.add_argument('recording', metavar='RECORDING', help='a bag, or a file of --raw')
    parser.add_argument('--topic', default='', help='the topic of a bag with several')
    parser.add_argument('--baud', type=lines.baud, default=0, metavar='N',
                        help='baud rate of the lines (default: that of a file of --raw, or that of '
                             "--config, or each board's default)")
    lines.add_config_option(parser)
    parser.add_argument('--json', action='store_true', help='the same as JSON; times in s')


def run(options: argparse.Namespace) -> int:
    """Print the statistics and return the exit status."""
    recording = load(options.recording, options.topic)
    line_of = lines.known_lines(options.config)
    baud = options.baud or recording.baud
    known = {link: learned_from(recording, _settings(link, recording, line_of, baud))
             for link in recording.links()}
    frames = sorted((each for line in known.values() for each in frames_of(recording, line)),
                    key=lambda each: each.frame.stamp)
    if not frames:
        raise WireError(f'{options.recording}: contains no frames')
    figures = measure(frames, known, bytes_read(recording))
    print(json.dumps(figures, indent=1) if options.json else render(figures))
    return 0


class _UnknownDecoder(StreamDecoder):
    """The decoder of an unknown board: finds and explains nothing."""

    STARTS = b'\0'

    def frame_at(self, at: int) -> Bad:
        return Bad(1, FRAMING, '')


def _settings(link: str, recording: Recording, line_of: Callable[[str, int], Settings],
              baud: int) -> Settings:
    """The settings of a link in the recording. An unknown link in a bag is still counted."""
    try:
        return line_of(link, baud)
    except lines.UnknownBoard as error:
        if link in recording.reads:
            raise
        print_note(f'wire: {error}; types of {link} are shown as numbers')
        board = Description(link, '', lambda sent, parameters: _UnknownDecoder())
        return Settings(board, baud or board.baud)


# -- figures --------------------------------------------------------------------------------


def naming(known: Dict[str, Settings]) -> Callable[[RecordedFrame], str]:
    """Return a function that names the type of a valid frame, as the protocol does."""
    names: Dict[Any, str] = {}     # each is looked up once

    def name(recorded: RecordedFrame) -> str:
        frame, line = recorded.frame, known[recorded.link]
        asked = frame.number if line.board.numbering is Numbering.FUNCTION else 0
        key = (recorded.link, recorded.sent, frame.type, asked)
        if key not in names:
            names[key] = lines.type_name(line, recorded.sent, frame)
        return names[key]

    return name


def bytes_read(recording: Recording) -> Dict[Tuple[str, bool], int]:
    """The number of bytes by link and direction, those between packets included.

    A bag of serial_msg holds frames and noise, not reads.
    """
    sizes: Dict[Tuple[str, bool], int] = {}
    for link, reads in recording.reads.items():
        for read in reads:
            sizes[link, read.sent] = sizes.get((link, read.sent), 0) + len(read.data)
    return sizes


def measure(frames: Sequence[RecordedFrame], known: Dict[str, Settings],
            sizes: Mapping[Tuple[str, bool], int] = MappingProxyType({})) -> Dict[str, Any]:
    """Return the figures by link and direction. Times are in seconds.

    Args:
        sizes: the bytes by link and direction, where they are known; else those of the frames.
    """
    length = max(frames[-1].frame.stamp - frames[0].frame.stamp, 1e-6)
    links: Dict[str, Any] = {}
    name_of = naming(known)
    for link in sorted({each.link for each in frames}):
        of_link = [each for each in frames if each.link == link]
        about = links[link] = {'baud': known[link].baud}
        for sent in (False, True):
            one_way = [each for each in of_link if each.sent == sent]
            if one_way:
                about['to the board' if sent else 'from the board'] = _direction(
                    one_way, length, known[link].baud, name_of, sizes.get((link, sent)))
        about.update(_extra_figures(known[link].board, of_link))
    return {'seconds': length, 'links': links}


def _direction(frames: Sequence[RecordedFrame], length: float, baud: int,
               name_of: Callable[[RecordedFrame], str], size: Optional[int]) -> Dict[str, Any]:
    errors: Dict[str, int] = {}
    by_type: Dict[str, List[float]] = {}
    delays: Dict[str, List[float]] = {}
    clock = BoardClock()
    if size is None:
        size = sum(len(each.frame.raw) for each in frames)
    share = size * _BITS_A_BYTE / baud / length
    for each in frames:
        frame = each.frame
        if frame.cause:
            errors[frame.cause] = errors.get(frame.cause, 0) + 1
        else:
            by_type.setdefault(name_of(each), []).append(frame.stamp)
            at = None if frame.ticks is None else clock.measured_at(frame.ticks, frame.stamp)
            if at is not None and frame.stamp - at <= MOST_DELAY:
                delays.setdefault(name_of(each), []).append(frame.stamp - at)
    return {
        'frames': len(frames), 'invalid': sum(errors.values()), 'errors': errors, 'bytes': size,
        # More than all of it: bytes had waited somewhere before they were recorded.
        'share of capacity': share if share <= _MOST_SHARE else None,
        'types': {name: dict({'count': len(stamps), 'per second': len(stamps) / length},
                             **spread(gaps(stamps)),
                             **spread(delays.get(name, ()), 'read delay'))
                  for name, stamps in sorted(by_type.items())}}


def _extra_figures(board: Description, frames: Sequence[RecordedFrame]) -> Dict[str, Any]:
    """The figures that only some boards have."""
    extra: Dict[str, Any] = {}
    valid = [each for each in frames if not each.frame.cause]
    beat, received = board.heartbeat, [each.frame for each in valid if not each.sent]
    if board.numbering is Numbering.FUNCTION:
        answered, unanswered = round_trips(valid)
        if answered or unanswered:
            extra['round trips'] = dict(spread(answered, 'round trip'), answered=len(answered),
                                        unanswered=unanswered)
    elif board.numbering is Numbering.SEQUENCE and received:
        extra['lost by SEQ'] = sum(
            (after.number - before.number - 1) % 256 for before, after
            in zip(received, received[1:]) if (after.number, after.raw)
            != (before.number, before.raw))     # a repeated frame does not mean 255 lost ones
    if beat:
        beats = gaps([each.frame.stamp for each in valid
                      if each.sent and each.frame.type == beat.type])
        if beats:
            extra['heartbeats'] = dict(spread(beats), count=len(beats) + 1, limit=beat.longest_gap,
                                       too_long=sum(gap > beat.longest_gap for gap in beats))
    return extra


def round_trips(frames: Sequence[RecordedFrame]) -> Tuple[List[float], int]:
    """Return the seconds from each request to its reply, and the number of requests without one.

    A reply belongs to the request before it.
    """
    answered: List[float] = []
    unanswered = 0
    asked: Optional[float] = None
    for each in frames:
        if each.sent:
            unanswered += asked is not None
            asked = each.frame.stamp
        elif asked is not None:
            answered.append(max(each.frame.stamp - asked, 0.0))
            asked = None
    return answered, unanswered + (asked is not None)


def gaps(stamps: Sequence[float]) -> List[float]:
    """Return the time from each stamp to the next."""
    return [after - before for before, after in zip(stamps, stamps[1:])]


def spread(values: Sequence[float], name: str = 'gap') -> Dict[str, Optional[float]]:
    """Return p50, p99 and max of the values, by name; None without values."""
    return {f'{name} p50': percentile(values, 50) if values else None,
            f'{name} p99': percentile(values, 99) if values else None,
            f'{name} max': max(values) if values else None}


# -- for users ------------------------------------------------------------------------------


def render(figures: Dict[str, Any]) -> str:
    """Return the figures as a table."""
    paint = Paint()
    bauds = sorted({about['baud'] for about in figures['links'].values()})
    text = [f'{figures["seconds"]:.1f} s at {" and ".join(map(str, bauds))} baud']
    for link, about in figures['links'].items():
        for name in ('from the board', 'to the board'):
            if name in about:
                text += [''] + _render_direction(f'{link}, {name}', about[name], paint)
        text += _render_extra(about, paint)
    return '\n'.join(text)


def _render_direction(title: str, figures: Dict[str, Any], paint: Paint) -> List[str]:
    invalid, share = figures['invalid'], figures['share of capacity']
    text = [f'{title}: {figures["frames"]} frames, {figures["bytes"]} bytes, '
            + (f'{share:.1%} of the wire, ' if share is not None else
               'more than the wire carries in this time (some had waited), ')
            + paint(f'{invalid} invalid', 'bad' if invalid else 'good')]
    timed = any(each['read delay max'] is not None for each in figures['types'].values())
    if figures['types']:
        text.append(f'  {"type":28}{"count":>8}{"per s":>9}{"gap p50":>11}{"p99":>9}{"max":>9}'
                    + f'{"delay p50":>11}{"max":>9}' * timed + '  ms')
    for name, each in figures['types'].items():
        text.append(f'  {name:28}{each["count"]:8}{each["per second"]:9.2f}'
                    f'{_ms(each["gap p50"]):>11}{_ms(each["gap p99"]):>9}'
                    f'{_ms(each["gap max"]):>9}'
                    + f'{_ms(each["read delay p50"]):>11}{_ms(each["read delay max"]):>9}' * timed)
    text += [f'  {paint("invalid: " + cause, "bad")}'.ljust(30) + f'{count:8}'
             for cause, count in sorted(figures['errors'].items())]
    return text


def _render_extra(about: Dict[str, Any], paint: Paint) -> List[str]:
    text = []

    def add(figures: str, bad: int, words: str) -> None:
        text.append(f'  {figures}' + paint(f'{bad} {words}', 'bad' if bad else 'good'))

    if 'round trips' in about:
        each = about['round trips']
        add(f'round trips: {each["answered"]}, {_spread(each, "round trip")}; ',
            each['unanswered'], 'requests without a reply')
    if 'heartbeats' in about:
        each = about['heartbeats']
        add(f'heartbeats: {each["count"]}, gap {_spread(each, "gap")}; ', each['too_long'],
            f'gaps over {each["limit"] * 1e3:g} ms, which stop the motor')
    if 'lost by SEQ' in about:
        add('', about['lost by SEQ'], 'frames lost, by their SEQ')
    return text


def _spread(each: Dict[str, Any], name: str) -> str:
    return ', '.join(f'{figure} {_ms(each[f"{name} {figure}"])}'
                     for figure in ('p50', 'p99', 'max')) + ' ms'


def _ms(value: Optional[float]) -> str:
    return '-' if value is None else f'{value * 1e3:.2f}'
