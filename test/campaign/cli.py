"""The fault campaign; arguments.py says what it does."""
import contextlib
import os
import signal
import sys
import time
from argparse import Namespace
from typing import Optional

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


def main(options: Namespace) -> int:
    prepare_output()
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
