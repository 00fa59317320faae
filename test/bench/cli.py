"""Measures latency, jitter and CPU time of the bridge on this machine. Takes about six minutes.

The bench starts its own roscore, the bridge, boards behind pseudo terminals, and the references: a
node that polls its port, a node that only publishes, and with --against the bridge of another
commit. All take turns in rounds of six seconds, and the best of four rounds counts. The exit status
is 0 if the bench worked, whatever it measured.
"""
import argparse
import json
import os
import platform
import signal
import sys
from typing import Dict, List, Optional

import psutil

from serial_communication.output import prepare_output
from processes import StageError
from .hostile import hostile
from .report import Results, judge, render
from .sections import SECTIONS, Plan
from .stage import BenchStage


def main(arguments: Optional[List[str]] = None) -> int:
    """Run the bench and return the exit status."""
    prepare_output()
    options = _parser().parse_args(arguments)
    plan = Plan(1.0, 2, 2) if options.short else Plan(6.0, 4, 10)
    signal.signal(signal.SIGTERM, signal.default_int_handler)    # the children end
    before, load = psutil.cpu_times(), os.getloadavg()[0]
    try:
        if options.hostile:
            return 0 if hostile() else 1
        results = measure(options.only, plan, options.against)
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130
    except StageError as error:
        print(f'bench: {error}', file=sys.stderr)
        return 1
    after = psutil.cpu_times()
    stolen = 100 * (after.steal - before.steal) / (sum(after) - sum(before))
    facts = (f'{os.cpu_count()} cores, Linux {platform.release()}, Python '
             f'{platform.python_version()}; load before: {load:.2f}; {stolen:.1f} % of the CPU '
             'taken by the host')
    titles = {name: f'{name}: {section.__doc__}' for name, section in SECTIONS.items()}
    print(render(facts, results, titles, options.against))
    if options.json:
        with open(options.json, 'w') as file:
            json.dump({'facts': facts, 'goals': judge(results), 'results': results}, file,
                      indent=1)
    return 0


def measure(names: List[str], plan: Plan, against: str) -> Dict[str, Results]:
    """Return the results of these sections, by name."""
    results = {}
    with BenchStage(against) as stage:
        for name in names:
            print(f'{name} ...', file=sys.stderr)
            results[name] = SECTIONS[name](stage, plan)
            stage.clear()
    return results


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='bench', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--short', action='store_true',
                        help='two rounds of one second each, only to check that the bench works')
    parser.add_argument('--against', metavar='COMMIT', default='',
                        help='build this commit and measure its bridge in the same rounds')
    parser.add_argument('--only', metavar='SECTION,...', type=_sections, default=list(SECTIONS),
                        help='measure only these sections, of ' + ', '.join(SECTIONS))
    parser.add_argument('--hostile', action='store_true',
                        help='measure only the cost of the worst bytes, compared with normal '
                             'traffic')
    parser.add_argument('--json', metavar='FILE', help='write the figures to this file')
    return parser


def _sections(text: str) -> List[str]:
    names = text.split(',')
    for name in names:
        if name not in SECTIONS:
            raise argparse.ArgumentTypeError(f"{name!r} is not one of {', '.join(SECTIONS)}")
    return names
