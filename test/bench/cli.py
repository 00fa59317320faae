"""How fast, how even and how cheap the node is on this machine. Takes about nine minutes.

It starts all it needs: a roscore of its own, the node, boards behind ptys, and what the node is
compared with: a node that polls its ports (the reference), and one that only publishes (the
floor). Exit status 0 if the bench worked, whatever it measured.
"""
import argparse
import json
import signal
import sys
from typing import Any, Dict, List, Optional, Tuple

from serial_communication.output import prepare_output
from progress import Progress
from processes import StageError
from .report import judge, plain, plot, render
from .sections import SECTIONS, Plan
from .stage import BenchStage, machine, stolen


def main(arguments: Optional[List[str]] = None) -> int:
    """Run it; returns the exit status."""
    prepare_output()
    options = _parser().parse_args(arguments)
    plan = Plan(options.duration or (1.0 if options.short else 3.5), 2 if options.short else 12,
                options.short)
    signal.signal(signal.SIGTERM, signal.default_int_handler)    # as Ctrl-C: end the children
    try:
        facts, results = measure(options.only, plan)
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130
    except StageError as error:
        print(f'the bench does not work: {error}', file=sys.stderr)
        return 1
    goals = judge(results)
    print(render(facts, goals, results), file=sys.stderr if options.json == '-' else sys.stdout)
    if options.json:
        everything = json.dumps(plain(dict(results, machine=facts, plan=plan, goals=goals)),
                                indent=1)
        if options.json == '-':
            print(everything)
        else:
            with open(options.json, 'w') as file:
                file.write(everything + '\n')
    if options.plot:
        _plot(results, options.plot)
    return 0


def measure(names: List[str], plan: Plan) -> Tuple[Dict[str, Any], Dict[str, list]]:
    """Facts about the machine, and the rows of the sections of these names."""
    chosen = {name: section for name, section in SECTIONS.items() if name in names}
    progress = Progress(total=sum(section.seconds(plan) for section in chosen.values()))
    facts, results, before = machine(), {}, stolen()
    with BenchStage() as stage:
        for name, section in chosen.items():
            with progress.phase(f'{name}: {section.run.__doc__.splitlines()[0]}'):
                results[name] = section.run(stage, plan)
                stage.clear()
    lost, spent = (after - then for after, then in zip(stolen(), before))
    facts['stolen %'] = round(100 * lost / spent, 2)
    facts['seconds'] = round(progress.seconds, 1)
    return facts, results


def _plot(results: Dict[str, Any], path: str) -> None:
    if 'scale' not in results:
        print('no plot: it shows the section "scale", which was not run', file=sys.stderr)
        return
    try:
        plot(results['scale'], path)
    except ImportError:
        print('no plot: it needs python3-matplotlib', file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='bench', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--short', action='store_true',
                        help='a second a turn, under a minute in all: to see that it works')
    parser.add_argument('--json', metavar='FILE', help='everything measured; - for stdout')
    parser.add_argument('--plot', metavar='FILE.png',
                        help='a picture of cost against load (of the section scale)')
    parser.add_argument('--only', metavar='SECTION,...', type=_sections, default=list(SECTIONS),
                        help='measure these alone, of ' + ', '.join(SECTIONS))
    parser.add_argument('--duration', metavar='S', type=float, default=0.0,
                        help='seconds a turn (3.5, with --short 1)')
    return parser


def _sections(text: str) -> List[str]:
    names = text.split(',')
    for name in names:
        if name not in SECTIONS:
            raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(SECTIONS)}")
    return names


if __name__ == '__main__':
    sys.exit(main())
