"""The fault campaign: what doc/reliability.md promises, held against a bridge that runs.

First the exact part: one fault after the other, on quiet lines, so that every comparison is exact.
Then all faults at once, and damage on every line, for as long as --duration or --hours say; every
half hour the exact part comes again. Ctrl-C ends it with the table of what it had. Status 0 only if
every promise held.
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
from .field import Field
from .rows import Table
from .storm import Storm

_SLICE = 1800.0          # s of the statistical part between two exact parts
_WRITE = 10.0            # s from one writing of the table to the next


def main(arguments: Optional[List[str]] = None) -> int:
    prepare_output()
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)    # as Ctrl-C: end the children
    signal.signal(signal.SIGHUP, signal.default_int_handler)
    table = Table()
    field = None
    try:
        print(f'seed {options.seed}', file=sys.stderr)
        field = Field(table, options.keep, options.bridge)
        with field:
            print('starting', file=sys.stderr)
            _keep_writing(field)
            _run(field, options)
        status, trouble = 0, ''
    except KeyboardInterrupt:
        status, trouble = 130, 'stopped'
    except StageError as error:
        status, trouble = 2, f'the campaign does not work: {error}'
    violated = _report(table, field, options)
    print(trouble, end='\n' if trouble else '', file=sys.stderr)
    return status or int(violated)


def _run(field: Field, options) -> None:
    left, number = options.duration, 0
    while True:
        if options.part != 'storm':
            exact.run(field, '' if options.part == 'all' else options.part)
        if options.part not in ('all', 'storm'):
            return
        storm = Storm(field, min(left, _SLICE), f'{options.seed} {number}', options.busy)
        exact.carry_out(field, [storm])
        field.clear_bridge()
        left, number = left - _SLICE, number + 1
        if left <= 0:
            return


def _keep_writing(field: Field) -> None:
    with contextlib.suppress(OSError):      # at the end the folder goes
        with open(field.path('table~'), 'w') as file:
            print(time.strftime('%F %T'), field.table.render(), field.table.summary(), sep='\n',
                  file=file)
        os.replace(field.path('table~'), field.path('table.txt'))
    field.clock.after(_WRITE, lambda: _keep_writing(field))


def _report(table: Table, field: Optional[Field], options) -> bool:
    """Whether a promise was broken. Only then, or where they are wanted, records stay."""
    print(table.render())
    print(table.summary())
    if options.json:
        with open(options.json, 'w') as file:
            file.write(table.as_json())
    if table.violated:
        print(f'records: {field.folder}')
    elif field:
        field.discard()
    return bool(table.violated)


def _parse(arguments: List[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='soak', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--duration', type=float, default=60.0, metavar='S',
                        help='seconds of the statistical part (%(default)g)')
    parser.add_argument('--hours', type=lambda text: float(text) * 3600, dest='duration',
                        metavar='N', help='the same in hours')
    parser.add_argument('--seed', type=int, metavar='N', help='so that a run can be repeated')
    parser.add_argument('--busy', type=int, default=2, metavar='N',
                        help='processes that take all the CPU they get, in the statistical part '
                             '(%(default)d)')
    parser.add_argument('--keep', default='', metavar='DIR',
                        help='where all records stay; without it they stay only if a promise was '
                             'broken')
    parser.add_argument('--json', metavar='FILE', help='the table, for programs')
    parser.add_argument('--part', default='all', metavar='NAME',
                        help='only the statistical part (storm), or scenarios of the exact part '
                             'with this in their name (exact_car, openings)')
    parser.add_argument('--bridge', default='', metavar='COMMAND',
                        help='run this instead of the node: to see that the campaign finds faults')
    options = parser.parse_args(arguments)
    if options.seed is None:
        options.seed = SystemRandom().randrange(1 << 31)
    if options.keep and os.path.isdir(options.keep) and os.listdir(options.keep):
        parser.error(f'{options.keep} is not empty')
    return options
