"""How a line was: what came how often, what was damaged, how full the wire was.

A recording is a bag of serial_msg (rosbag record /serial_msg), with every link in it, or what
wire listen --raw and wire tap --raw wrote. For each link, each direction and each type: how many,
how many a second, the gaps between them; errors by cause; the share of the wire's capacity; for
the bus the round trips; for the arduino the gaps between heartbeats, of which one over 30 ms
stops the motor. Of a bag's link that is not known, types are numbers.

  wire stats drive.bag
  wire stats drive.bag --plot drive.png      a timeline with the errors marked
"""
import argparse
import json
from typing import Any, Callable, Dict, List, Optional, Sequence

from ...boards.description import Command, Description
from ...framing.stream import FRAMING, Bad, StreamDecoder
from . import lines
from .figures import percentile
from .lines import Settings
from .recording import Recording, Seen, frames_of, load
from .show import Paint, Trouble, complain

SUMMARY = 'of a recording: counts, gaps, errors, load, round trips; a plot'

_MATPLOTLIB = ('the plot needs matplotlib; install it: sudo apt-get install python3-matplotlib')
_BITS_A_BYTE = 10        # start, eight, stop


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the command line may say."""
    parser.add_argument('recording', metavar='RECORDING', help='a bag, or a file of --raw')
    parser.add_argument('--topic', default='', help='of the bag, where several have frames')
    parser.add_argument('--baud', type=lines.baud, default=0, metavar='N',
                        help="of the lines (a file of --raw says it; else each board's own)")
    lines.add_config_option(parser)
    parser.add_argument('--plot', metavar='FILE.png', help='a timeline with the errors marked')
    parser.add_argument('--json', action='store_true', help='the same for a program; times in s')


def run(options: argparse.Namespace) -> int:
    """Say it; the exit status."""
    recording = load(options.recording, options.topic)
    line_of = lines.known_lines(options.config)
    baud = options.baud or recording.baud
    known = {link: _settings(link, recording, line_of, baud) for link in recording.links()}
    seen = sorted((each for line in known.values() for each in frames_of(recording, line)),
                  key=lambda each: each.frame.stamp)
    if not seen:
        raise Trouble(f'{options.recording}: there is no frame in it')
    figures = measure(seen, known)
    print(json.dumps(figures, indent=1) if options.json else render(figures))
    if options.plot:
        try:
            plot(seen, known, options.plot)
        except ImportError:
            raise Trouble(_MATPLOTLIB) from None
        except (OSError, ValueError) as error:
            raise Trouble(f'{options.plot}: {error}') from None
    return 0


class _NoFrames(StreamDecoder):
    """Of a board that is not known: finds and explains nothing."""

    STARTS = b'\0'

    def frame_at(self, at: int) -> Bad:
        return Bad(1, FRAMING, '')


def _settings(link: str, recording: Recording, line_of: Callable[[str, int], Settings],
              baud: int) -> Settings:
    """Of a link in the recording; of one that is not known, a bag can be counted all the same."""
    try:
        return line_of(link, baud)
    except lines.UnknownBoard as error:
        if link in recording.reads:
            raise
        complain(f'wire: {error}; of {link}, types are shown by their numbers')
        board = Description(link, '', lambda sent, parameters: _NoFrames())
        return Settings(board, baud or board.baud)


# -- figures --------------------------------------------------------------------------------


def naming(known: Dict[str, Settings]) -> Callable[[Seen], str]:
    """A function that gives the kind of a good frame, in the protocol's words."""
    names: Dict[Any, str] = {}     # each is looked up once

    def name(seen: Seen) -> str:
        frame, line = seen.frame, known[seen.link]
        asked = frame.command if line.board.command is Command.FUNCTION else 0
        key = (seen.link, seen.sent, frame.type, asked)
        if key not in names:
            names[key] = lines.type_name(line, seen.sent, frame)
        return names[key]

    return name


def measure(seen: Sequence[Seen], known: Dict[str, Settings]) -> Dict[str, Any]:
    """Everything that is told, by link and direction. Times are in seconds."""
    length = max(seen[-1].frame.stamp - seen[0].frame.stamp, 1e-6)
    links: Dict[str, Any] = {}
    name_of = naming(known)
    for link in sorted({each.link for each in seen}):
        of_link = [each for each in seen if each.link == link]
        about = links[link] = {'baud': known[link].baud}
        for sent in (False, True):
            frames = [each for each in of_link if each.sent == sent]
            if frames:
                about['to the board' if sent else 'from the board'] = _direction(
                    frames, length, known[link].baud, name_of)
        about.update(_extra_figures(known[link].board, of_link))
    return {'seconds': length, 'links': links}


def _direction(seen: Sequence[Seen], length: float, baud: int,
               name_of: Callable[[Seen], str]) -> Dict[str, Any]:
    errors: Dict[str, int] = {}
    by_type: Dict[str, List[float]] = {}
    size = 0
    for each in seen:
        frame = each.frame
        size += len(frame.raw)
        if frame.cause:
            errors[frame.cause] = errors.get(frame.cause, 0) + 1
        else:
            by_type.setdefault(name_of(each), []).append(frame.stamp)
    return {
        'frames': len(seen), 'bad': sum(errors.values()), 'errors': errors, 'bytes': size,
        'share of capacity': size * _BITS_A_BYTE / baud / length,
        'types': {name: dict({'count': len(stamps), 'per second': len(stamps) / length},
                             **spread(gaps(stamps))) for name, stamps in sorted(by_type.items())}}


def _extra_figures(board: Description, seen: Sequence[Seen]) -> Dict[str, Any]:
    """What only some boards have."""
    own: Dict[str, Any] = {}
    good = [each for each in seen if not each.frame.cause]
    beat, received = board.heartbeat, [each.frame for each in good if not each.sent]
    if board.command is Command.FUNCTION:
        answered, unanswered = round_trips(good)
        if answered or unanswered:
            own['round trips'] = dict(spread(answered, 'round trip'), answered=len(answered),
                                      unanswered=unanswered)
    elif board.command is Command.SEQUENCE and received:
        own['lost by SEQ'] = sum(
            (after.command - before.command - 1) % 256 for before, after
            in zip(received, received[1:]) if (after.command, after.raw)
            != (before.command, before.raw))     # a frame that came twice is not lost 255 times
    if beat:
        beats = gaps([each.frame.stamp for each in good
                      if each.sent and each.frame.type == beat.type])
        if beats:
            own['heartbeats'] = dict(spread(beats), count=len(beats) + 1, limit=beat.longest_gap,
                                     too_long=sum(gap > beat.longest_gap for gap in beats))
    return own


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
    bauds = sorted({about['baud'] for about in figures['links'].values()})
    text = [f'{figures["seconds"]:.1f} s at {" and ".join(map(str, bauds))} baud']
    for link, about in figures['links'].items():
        for name in ('from the board', 'to the board'):
            if name in about:
                text += [''] + _render_direction(f'{link}, {name}', about[name], paint)
        text += _render_custom(about, paint)
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


def _render_custom(about: Dict[str, Any], paint: Paint) -> List[str]:
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


def plot(seen: Sequence[Seen], known: Dict[str, Settings], path: str) -> None:
    """A row a link, direction and type, or cause of errors.

    Raises:
        ImportError: matplotlib is missing.
        OSError, ValueError: the file cannot be written, or is of no kind that can be.
    """
    import matplotlib
    matplotlib.use('Agg')
    from matplotlib import pyplot

    name_of = naming(known)
    rows: Dict[Any, List[float]] = {}      # by name, and whether it is of errors
    for each in seen:
        name = f'{each.link} {"->" if each.sent else "<-"} {each.frame.cause or name_of(each)}'
        rows.setdefault((name, bool(each.frame.cause)), []).append(each.frame.stamp)
    figure, axes = pyplot.subplots(figsize=(12, 1.5 + 0.3 * len(rows)))
    in_order = sorted(rows, reverse=True)
    for height, (name, is_bad) in enumerate(in_order):
        stamps = rows[name, is_bad]
        axes.plot(stamps, [height] * len(stamps), 'rx' if is_bad else 'k|')
        for stamp in stamps if is_bad else ():
            axes.axvline(stamp, color='red', alpha=0.15, linewidth=0.8)
    axes.set_yticks(range(len(in_order)))
    axes.set_yticklabels([name for name, _ in in_order])
    axes.set_xlabel('s')
    figure.savefig(path, bbox_inches='tight', dpi=100)
    pyplot.close(figure)
