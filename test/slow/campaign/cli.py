"""Runs the storm, and prints the table of the results."""
import contextlib
import math
import os
import signal
import sys
from argparse import Namespace

from bench.processes import StageError
from serial_communication.output import prepare_output
from .lines import NetworkLine, SerialLine
from .requirements import Table
from .rig import NAMES, Rig
from .storm import Storm

_ROUND = 3600.0              # s with one bridge
_STOPPED = 130               # exit status after a Ctrl-C
_PRIORITY = 2                # real-time, above the bridge's threads, below its heartbeat
_SWITCH_INTERVAL = 5e-4      # s, of Python's threads


def main(options: Namespace) -> int:
    prepare_output()
    # Read what the bridge writes at once, also while the machine is busy, if the system allows it.
    # All threads of this process inherit this, its children do not.
    sys.setswitchinterval(_SWITCH_INTERVAL)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    table, rig, status, error_text = Table(), None, 0, ''
    for number in signal.SIGTERM, signal.SIGHUP:
        signal.signal(number, signal.default_int_handler)    # as Ctrl-C, so that children are ended
    try:
        print(f'seed {options.seed}', file=sys.stderr)
        rig = Rig(table, options.keep)
        with rig:
            for number in range(math.ceil(options.duration / _ROUND)):
                _run(rig, min(_ROUND, options.duration - number * _ROUND),
                     f'{options.seed} {number}', options.busy)
    except KeyboardInterrupt:
        status, error_text = _STOPPED, 'stopped'
    except StageError as error:
        status, error_text = 2, f'the campaign does not work: {error}'
    print(table)
    if table.failed:        # keep the records
        print(f'records: {rig.folder}' if rig else 'no records', file=sys.stderr)
    elif rig:
        rig.discard()
    print(error_text, end='\n' if error_text else '', file=sys.stderr)
    return status or int(bool(table.failed))


def _run(rig: Rig, duration: float, seed: str, busy: int) -> None:
    """One half on serial lines, the other half with the boards behind networks."""
    for line in SerialLine, NetworkLine:
        rig.use_lines({name: line(rig.path(f'{name}_{seed}'.replace(' ', '_'))) for name in NAMES})
        storm, error_text = Storm(rig, duration / 2, f'{seed} {rig.is_network}', busy), ''
        print(f'{storm} ...', file=sys.stderr)
        try:
            storm.run()
        except Exception as error:  # pylint: disable=broad-except
            error_text = f'{type(error).__name__}: {error}'
        rig.row('every part runs to its end').check(not error_text, f'{storm}: {error_text}')
    rig.table.minutes += duration / 60
