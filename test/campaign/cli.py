"""The fault campaign: checks the requirements of doc/reliability.md against a running bridge.

The exact part has one fault at a time on quiet lines, so every comparison is exact. Then the
statistical part has all faults at once, and damage on every line, for --duration or --hours. Every
half hour the exact part is repeated. After Ctrl-C it prints the table of the results so far. The
exit status is 0 only if no requirement was violated, and each was tried as often as it has to be.

soak --broken [NAME...] runs it on the broken bridges of test/campaign/broken instead.
"""
import argparse
import contextlib
import os
import signal
import sys
import time
from random import SystemRandom
from typing import List, Optional

from processes import StageError
from serial_communication.output import prepare_output
from . import exact
from .requirements import Table
from .rig import Rig
from .storm import Storm

_STORM_DURATION = 1800.0     # s of the statistical part between two exact parts
_TABLE_PERIOD = 10.0         # s
_PRIORITY = 2                # real-time, above the bridge's threads, below its heartbeat
_SWITCH_INTERVAL = 5e-4      # s, of Python's threads


def main(arguments: Optional[List[str]] = None) -> int:
    prepare_output()
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    for number in signal.SIGTERM, signal.SIGHUP:
        signal.signal(number, signal.default_int_handler)    # as Ctrl-C, so that children are ended
    table = Table()
    rig = None
    try:
        print(f'seed {options.seed}', file=sys.stderr)
        _come_first()
        rig = Rig(table, options.keep, options.bridge)
        with rig:
            print('starting', file=sys.stderr)
            _write_table_regularly(rig)
            _run(rig, options)
        status, error_text = 0, ''
    except KeyboardInterrupt:
        status, error_text = 130, 'stopped'
    except StageError as error:
        status, error_text = 2, f'the campaign does not work: {error}'
    is_green = _report(table, rig, options)
    print(error_text, end='\n' if error_text else '', file=sys.stderr)
    return status or int(not is_green)


def _come_first() -> None:
    """Read what the bridge writes at once, also while the machine is busy, if the system allows
    it. All threads of this process inherit this, its children do not."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))


def _run(rig: Rig, options) -> None:
    left, number = options.duration, 0
    while True:
        if options.part != 'storm':
            exact.run(rig, '' if options.part in ('all', 'exact') else options.part)
        if options.part not in ('all', 'storm'):
            return
        duration = min(left, _STORM_DURATION)
        exact.carry_out(rig, [Storm(rig, duration, f'{options.seed} {number}', options.busy)])
        rig.table.has_run('storm', duration / 60)
        rig.end_bridge()
        left, number = left - _STORM_DURATION, number + 1
        if left <= 0:
            return


def _write_table_regularly(rig: Rig) -> None:
    with contextlib.suppress(OSError):      # the folder is deleted at the end
        with open(rig.path('table~'), 'w') as file:
            print(time.strftime('%F %T'), rig.table.render(), rig.table.summary(), sep='\n',
                  file=file)
        os.replace(rig.path('table~'), rig.path('table.txt'))
    rig.clock.after(_TABLE_PERIOD, lambda: _write_table_regularly(rig))


def _report(table: Table, rig: Optional[Rig], options) -> bool:
    """Print the table. Keep the records unless it is green, which is returned."""
    print(table.render(), table.summary(), sep='\n')
    if options.json:
        with open(options.json, 'w') as file:
            file.write(table.as_json())
    if not table.is_green:
        print(f'records: {rig.folder}' if rig else 'no records', file=sys.stderr)
    elif rig:
        rig.discard()
    return table.is_green


def _parse(arguments: List[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='soak', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--duration', type=float, default=60.0, metavar='S',
                        help='duration of the statistical part in seconds (%(default)g)')
    parser.add_argument('--hours', type=lambda text: float(text) * 3600, dest='duration',
                        metavar='N', help='the same in hours')
    parser.add_argument('--seed', type=int, metavar='N', default=SystemRandom().randrange(1 << 31),
                        help='seed of the random numbers, to repeat a run')
    parser.add_argument('--busy', type=int, default=2, metavar='N',
                        help='busy processes during the statistical part (%(default)d)')
    parser.add_argument('--keep', default='', metavar='DIR',
                        help='keep all records here, not only those of a violation')
    parser.add_argument('--json', metavar='FILE', help='write the table to this file as JSON')
    parser.add_argument('--part', default='all', metavar='NAME',
                        help='run only this part (exact or storm), or only the scenarios of the '
                             'exact part with NAME in their name (exact_car, openings)')
    parser.add_argument('--bridge', default='', metavar='COMMAND',
                        help='run this command instead of the node, to test the campaign')
    options = parser.parse_args(arguments)
    if options.keep and os.path.isdir(options.keep) and os.listdir(options.keep):
        parser.error(f'{options.keep} is not empty')
    return options
