"""How a line was: what came how often, what was damaged, how full the wire was.

A recording is a bag of serial_msg (rosbag record /serial_msg), with every link in it, or what
wire listen --raw and wire tap --raw wrote. For each link, each direction and each type: how many,
how many a second, the gaps between them; errors by cause; the share of the wire's capacity; for
the bus the round trips; for the arduino the gaps between heartbeats, of which one over 30 ms
stops the motor.

  wire stats drive.bag
  wire stats drive.bag --plot drive.png      a timeline with the errors marked
"""
import argparse
import json
import sys
from typing import Any, Dict, List, Optional, Sequence

from ...boards.description import Command, Description
from .figures import percentile
from . import lines
from .lines import Settings
from .recording import Recording, RecordingError, Seen, decoded, load
from .show import Paint

SUMMARY = 'of a recording: counts, gaps, errors, load, round trips; a plot'

_MATPLOTLIB = ('the plot needs matplotlib; install it: sudo apt-get install python3-matplotlib')
_BITS_A_BYTE = 10        # start, eight, stop


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the command line may say."""
    parser.add_argument('recording', metavar='RECORDING', help='a bag, or a file of --raw')
    parser.add_argument('--topic', default='', help='of the bag, where several have frames')
    parser.add_argument('--baud', type=lines.baud, default=0, metavar='N',
                        help=f'of the lines (a file of --raw says it; else {lines.BAUD})')
    lines.add_config_option(parser)
    parser.add_argument('--plot', metavar='FILE.png', help='a timeline with the errors marked')
    parser.add_argument('--json', action='store_true', help='the same for a program; times in s')


def run(options: argparse.Namespace) -> int:
    """Say it; the exit status."""
    try:
        recording = load(options.recording, options.topic)
    except RecordingError as error:
        print(error, file=sys.stderr)
        return 1
    line_of = lines.known_lines(options.config)
    known = {link: line_of(link, options.baud or recording.baud) for link in recording.links()}
    seen = all_frames(recording, known)
    if not seen:
        print(f'{options.recording}: there is no frame in it', file=sys.stderr)
        return 1
    figures = measure(seen, known)
    print(json.dumps(figures, indent=1) if options.json else render(figures))
    if options.plot:
        try:
            plot(seen, known, options.plot)
        except ImportError:
            print(_MATPLOTLIB, file=sys.stderr)
            return 1
        except (OSError, ValueError) as error:
            print(f'{options.plot}: {error}', file=sys.stderr)
            return 1
    return 0


def all_frames(recording: Recording, known: Dict[str, Settings]) -> List[Seen]:
    """Of all links, in the order of their times."""
    seen = list(recording.seen)
    for link, reads in recording.reads.items():
        seen += decoded(reads, known[link])
    return sorted(seen, key=lambda each: each.frame.stamp)


# -- figures --------------------------------------------------------------------------------


class Names:
    """What good frames are, in the protocol's words; each kind is looked up once."""

    def __init__(self, known: Dict[str, Settings]) -> None:
        self._lines = known
        self._names: Dict[Any, str] = {}

    def __call__(self, seen: Seen) -> str:
        frame = seen.frame
        line = self._lines[seen.link]
        asked = frame.command if line.board.command is Command.FUNCTION else 0
        key = (seen.link, seen.sent, frame.type, asked)
        if key not in self._names:
            self._names[key] = lines.type_name(line, seen.sent, frame)
        return self._names[key]


def measure(seen: Sequence[Seen], known: Dict[str, Settings]) -> Dict[str, Any]:
    """Everything that is told, by link and direction. Times are in seconds."""
    baud = next(iter(known.values())).baud
    first, last = seen[0].frame.stamp, seen[-1].frame.stamp
    length = max(last - first, 1e-6)
    links: Dict[str, Any] = {}
    names = Names(known)
    for link in sorted({each.link for each in seen}):
        of_link = [each for each in seen if each.link == link]
        about: Dict[str, Any] = {}
        for sent in (False, True):
            frames = [each for each in of_link if each.sent == sent]
            if frames:
                about['to the board' if sent else 'from the board'] = _direction(
                    frames, length, baud, names)
        about.update(_own_figures(known[link].board, of_link))
        links[link] = about
    return {'seconds': length, 'baud': baud, 'links': links}


def _direction(seen: Sequence[Seen], length: float, baud: int, names: Names) -> Dict[str, Any]:
    errors: Dict[str, int] = {}
    by_type: Dict[str, List[float]] = {}
    size = 0
    for each in seen:
        frame = each.frame
        size += len(frame.raw)
        if frame.cause:
            errors[frame.cause] = errors.get(frame.cause, 0) + 1
        else:
            by_type.setdefault(names(each), []).append(frame.stamp)
    return {
        'frames': len(seen), 'bad': sum(errors.values()), 'errors': errors, 'bytes': size,
        'share of capacity': size * _BITS_A_BYTE / baud / length,
        'types': {name: dict({'count': len(stamps), 'per second': len(stamps) / length},
                             **spread(gaps(stamps))) for name, stamps in sorted(by_type.items())}}


def _own_figures(board: Description, seen: Sequence[Seen]) -> Dict[str, Any]:
    """What only this kind of link has."""
    good = [each for each in seen if not each.frame.cause]
    if board.command is Command.FUNCTION:
        answered, unanswered = round_trips(good)
        return {'round trips': dict(spread(answered, 'round trip'), answered=len(answered),
                                    unanswered=unanswered)} if answered or unanswered else {}
    if board.heartbeat:
        beats = gaps([each.frame.stamp for each in good
                      if each.sent and each.frame.type == board.heartbeat.type])
        return {'heartbeats': dict(spread(beats), count=len(beats) + 1, too_long=sum(
            gap > board.heartbeat.longest_gap for gap in beats))} if beats else {}
    if board.command is not Command.SEQUENCE:
        return {}
    numbers = [(each.frame.command, each.frame.raw) for each in good if not each.sent]
    return {'lost by SEQ': sum((after[0] - before[0] - 1) % 256
                               for before, after in zip(numbers, numbers[1:])
                               if after != before)} if numbers else {}


def round_trips(seen: Sequence[Seen]) -> Any:
    """Seconds from each request to the reply before the next one; how many had none."""
    answered: List[float] = []
    unanswered = 0
    asked: Optional[float] = None
    for each in seen:
        if each.sent:
            unanswered += asked is not None
            asked = each.frame.stamp
        elif asked is not None:
            answered.append(max(each.frame.stamp - asked, 0.0))
            asked = None
    return answered, unanswered + (asked is not None)


def gaps(stamps: Sequence[float]) -> List[float]:
    """From each to the next."""
    return [after - before for before, after in zip(stamps, stamps[1:])]


def spread(values: Sequence[float], name: str = 'gap') -> Dict[str, Optional[float]]:
    """p50, p99 and max; None without values."""
    return {f'{name} p50': percentile(values, 50) if values else None,
            f'{name} p99': percentile(values, 99) if values else None,
            f'{name} max': max(values) if values else None}


# -- for people -----------------------------------------------------------------------------


def render(figures: Dict[str, Any]) -> str:
    """As a table."""
    paint = Paint()
    text = [f'{figures["seconds"]:.1f} s at {figures["baud"]} baud']
    for link, about in figures['links'].items():
        for name in ('from the board', 'to the board'):
            if name in about:
                text += [''] + _render_direction(f'{link}, {name}', about[name], paint)
        text += _render_own(about, paint)
    return '\n'.join(text)


def _render_direction(title: str, figures: Dict[str, Any], paint: Paint) -> List[str]:
    bad = figures['bad']
    text = [f'{title}: {figures["frames"]} frames, {figures["bytes"]} bytes, '
            f'{figures["share of capacity"]:.1%} of the wire, '
            + paint(f'{bad} bad', 'bad' if bad else 'good')]
    if figures['types']:
        text.append(f'  {"type":28}{"count":>8}{"per s":>9}{"gap p50":>11}{"p99":>9}{"max":>9}'
                    '  ms')
    for name, each in figures['types'].items():
        text.append(f'  {name:28}{each["count"]:8}{each["per second"]:9.2f}'
                    f'{_ms(each["gap p50"]):>11}{_ms(each["gap p99"]):>9}'
                    f'{_ms(each["gap max"]):>9}')
    text += [f'  {paint("bad: " + cause, "bad")}'.ljust(30) + f'{count:8}'
             for cause, count in sorted(figures['errors'].items())]
    return text


def _render_own(about: Dict[str, Any], paint: Paint) -> List[str]:
    text = []
    if 'round trips' in about:
        each = about['round trips']
        text.append(f'  round trips: {each["answered"]}, p50 {_ms(each["round trip p50"])}, p99 '
                    f'{_ms(each["round trip p99"])}, max {_ms(each["round trip max"])} ms; '
                    + paint(f'{each["unanswered"]} requests without a reply',
                            'bad' if each['unanswered'] else 'good'))
    if 'heartbeats' in about:
        each = about['heartbeats']
        text.append(f'  heartbeats: {each["count"]}, gap p50 {_ms(each["gap p50"])}, p99 '
                    f'{_ms(each["gap p99"])}, max {_ms(each["gap max"])} ms; '
                    + paint(f'{each["too_long"]} gaps over 30 ms, which stop the motor',
                            'bad' if each['too_long'] else 'good'))
    if 'lost by SEQ' in about:
        lost = about['lost by SEQ']
        text.append('  ' + paint(f'{lost} frames lost, by their SEQ', 'bad' if lost else 'good'))
    return text


def _ms(value: Optional[float]) -> str:
    return '-' if value is None else f'{value * 1e3:.2f}'


def plot(seen: Sequence[Seen], known: Dict[str, Settings], path: str) -> None:
    """A row a link, direction and type; the errors of a link and direction in one more.

    Raises:
        ImportError: matplotlib is missing.
        OSError, ValueError: the file cannot be written, or is of no kind that can be.
    """
    import matplotlib
    matplotlib.use('Agg')
    from matplotlib import pyplot

    names = Names(known)
    rows: Dict[str, List[float]] = {}
    errors: Dict[str, Dict[str, List[float]]] = {}
    for each in seen:
        row = f'{each.link} {"->" if each.sent else "<-"} '
        if each.frame.cause:
            row += 'errors'
            errors.setdefault(row, {}).setdefault(each.frame.cause, []).append(each.frame.stamp)
        else:
            row += names(each)
        rows.setdefault(row, []).append(each.frame.stamp)
    in_order = sorted(rows, reverse=True)
    figure, axes = pyplot.subplots(figsize=(12, 1.5 + 0.3 * len(in_order)))
    for height, name in enumerate(in_order):
        if name in errors:
            for cause, stamps in sorted(errors[name].items()):
                axes.plot(stamps, [height] * len(stamps), 'x', label=f'{name}: {cause}')
                for stamp in stamps:
                    axes.axvline(stamp, color='red', alpha=0.15, linewidth=0.8)
        else:
            axes.plot(rows[name], [height] * len(rows[name]), '|', color='black')
    axes.set_yticks(range(len(in_order)))
    axes.set_yticklabels(in_order)
    axes.set_xlabel('s')
    if errors:
        axes.legend(loc='upper left', bbox_to_anchor=(1.0, 1.0), fontsize='small')
    figure.savefig(path, bbox_inches='tight', dpi=100)
    pyplot.close(figure)
