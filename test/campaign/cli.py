"""The fault campaign: the bridge on the worst of days, and what it made of it.

Everything runs on this machine: a roscore of its own, the bridge, three simulated boards with
every fault they know, callers, commanders, subscribers, ports that come and go. Afterwards the
boards' journals are held against what callers were told and what was published. Exit status 0
only if every invariant held.
"""
import argparse
import json
import os
import signal
import sys
from random import SystemRandom
from typing import List, Optional

from serial_communication.output import prepare_output
from processes import StageError
from .hostile import decoder_costs, node_costs, render_costs, rows_of
from .judge import judge
from .run import Campaign
from .schedule import LEAST
from .shutdown import Shutdown
from .stage import CampaignStage, say
from .table import as_dict, render


def main(arguments: Optional[List[str]] = None) -> int:
    """Run what the command line says; the exit status."""
    prepare_output()
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)    # as Ctrl-C: end the children
    signal.signal(signal.SIGHUP, signal.default_int_handler)
    if options.judge:
        return _report(judge(options.judge), options, options.judge)
    if options.hostile:
        return _hostile(options)
    stage = None
    try:
        say(f'seed {options.seed}')
        stage = CampaignStage(options.keep, options.bridge)
        with stage:
            Campaign(stage, options.duration, options.seed, options.busy).run()
            ends = Shutdown(stage, options.seed).run(not options.bridge)
        say('judging')
        rows = judge(stage.folder) + ends
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        if stage:
            stage.discard()
        return 130
    except StageError as error:
        print(f'the campaign does not work: {error}', file=sys.stderr)
        return 2
    status = _report(rows, options, stage.folder)
    if not status:
        stage.discard()
    return status


def _hostile(options) -> int:
    try:
        say('decoders')
        decoders = decoder_costs()
        with CampaignStage(options.keep, options.bridge) as stage:
            nodes = node_costs(stage, decoders)
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130
    except StageError as error:
        print(f'soak --hostile does not work: {error}', file=sys.stderr)
        return 2
    print(render_costs('decoder', decoders))
    print()
    print(render_costs('whole node', nodes))
    print()
    status = _report(rows_of(decoders, nodes), options, stage.folder)
    stage.discard()
    return status


def _report(rows, options, folder: str) -> int:
    print(render(rows))
    failed = [row for row in rows if row.violations]
    print(f'{sum(row.judged for row in rows)} invariants, {len(failed)} violated')
    if failed:
        print(f'evidence: {folder}')
    if options.json:
        with open(options.json, 'w') as file:
            json.dump({'seed': options.seed, 'duration': options.duration, 'folder': folder,
                       'rows': [as_dict(row) for row in rows]}, file, indent=1)
    return 1 if failed else 0


def _parse(arguments: List[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='soak', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--duration', type=_seconds, default=60.0, metavar='S',
                        help='seconds of faults (%(default)g); starting and judging come on top')
    parser.add_argument('--seed', type=int, metavar='N', help='so that a run can be repeated')
    parser.add_argument('--busy', type=int, default=2, metavar='N',
                        help='processes that take all the CPU they get (%(default)d)')
    parser.add_argument('--keep', default='', metavar='DIR',
                        help='keep all records there; without it they stay only if an invariant '
                             'did not hold')
    parser.add_argument('--json', metavar='FILE', help='the table, for programs')
    parser.add_argument('--bridge', default='', metavar='COMMAND',
                        help='run this instead of the node: to see that the campaign finds faults')
    parser.add_argument('--hostile', action='store_true',
                        help='instead: what the worst bytes cost, beside clean traffic')
    parser.add_argument('--judge', metavar='DIR', help='run nothing: judge the records there')
    options = parser.parse_args(arguments)
    if options.seed is None:
        options.seed = SystemRandom().randrange(1 << 31)
    if options.keep and os.path.isdir(options.keep) and os.listdir(options.keep):
        parser.error(f'{options.keep} is not empty')
    return options


def _seconds(text: str) -> float:
    value = float(text)
    if not LEAST <= value <= 1e6:
        raise argparse.ArgumentTypeError(f'{text} s, may be {LEAST:g} to 1000000: in less, faults '
                                         'that exclude each other would overlap')
    return value


if __name__ == '__main__':
    sys.exit(main())
