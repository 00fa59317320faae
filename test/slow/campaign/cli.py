"""Runs the parts of the campaign, and prints the table of the results."""
import contextlib
import math
import os
import signal
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any, Dict, Iterator, NamedTuple, Sequence, Tuple, Type

from processes import StageError
from serial_communication.output import prepare_output
from . import (exact_bus, exact_car, exact_data, exact_faults, exact_node, exact_parameters,
               exact_settings)
from .lines import NetworkLine, Rfc2217Line, SerialLine
from .requirements import Table
from .rig import NAMES, Rig, Scenario
from .storm import Storm

_LOG_LINES = Path(__file__).with_name('log_lines.txt')
_ROUND = 3600.0              # s of the statistical part between two exact parts
_GRACE = 20.0                # s that a share of the exact part may take to end
_STOPPED = 130               # exit status after a Ctrl-C, or the violation of `--until`
_TRIES = 8                   # of a scenario that the machine spoils
_PRIORITY = 2                # real-time, above the bridge's threads, below its heartbeat
_SWITCH_INTERVAL = 5e-4      # s, of Python's threads


class Group(NamedTuple):
    """Scenarios of the exact part with one bridge."""

    scenarios: Tuple[Scenario, ...]
    parameters: Dict[str, Any] = {}
    line: Type[SerialLine] = SerialLine     # what the boards are behind
    events: Sequence[str] = ()      # patterns; if all scenarios were run, its log has each


# Each share of the exact part is a process; they take about the same time.
SHARES = (
    (Group((*exact_bus.SERIAL, *exact_car.SERIAL, *exact_data.SERIAL, *exact_faults.SERIAL,
            *exact_node.SERIAL, exact_settings.no_rows),
           # The bridge says that it does not know the first one.
           {'arduino/speed_time_out': 1.0, 'settings/arduino/trim': 300},
           events=_LOG_LINES.read_text().splitlines()),),
    (Group((*exact_car.LONG, *exact_data.LONG, *exact_faults.LONG),
           events=['arduino: IMU data was still received']),
     Group((exact_node.killed, exact_node.simulated_time)),
     Group((*exact_settings.SERIAL, exact_car.endless_calibration), exact_settings.PARAMETERS,
           events=['arduino: the calibration did not end within']),
     Group((exact_bus.polls,), exact_node.POLLING),
     Group((exact_bus.announced,), {'bus/announcements': True}),
     Group((exact_bus.one_poll,), exact_bus.ONE_POLL),
     Group((exact_bus.never_echoes,), {'bus/echo': False}),
     Group((exact_faults.no_limits,), exact_faults.NO_LIMITS),
     Group((exact_faults.queued,), {'bus/motion_timeout': exact_faults.LONG_TIMEOUT}),
     Group((exact_parameters.others, exact_node.ends)),
     Group((*exact_faults.NETWORK, exact_node.ends), line=NetworkLine),
     Group((exact_data.measurements, exact_car.commands, exact_bus.readings, exact_faults.closed),
           line=Rfc2217Line)))
GROUPS = [group for share in SHARES for group in share]


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
        rig = Rig(table, options.keep, options.bridge)
        table.until = options.until
        # The storm is ended as by Ctrl-C, from any thread.
        table.on_violation.append(lambda text, _example: table.part == 'storm'
                                  and text == table.until and os.kill(os.getpid(), signal.SIGINT))
        with rig:
            print('starting', file=sys.stderr)
            _run(rig, options)
    except KeyboardInterrupt:
        status, error_text = _STOPPED, 'stopped'
    except StageError as error:
        status, error_text = 2, f'the campaign does not work: {error}'
    print(table if options.share is None else table.dump())
    if table.failed:        # keep the records
        print(f'records: {rig.folder}' if rig else 'no records', file=sys.stderr)
    elif rig:
        rig.discard()
    print(error_text, end='\n' if error_text else '', file=sys.stderr)
    return status or int(bool(table.failed))


def _run(rig: Rig, options: Namespace) -> None:
    if options.share is not None:
        run_scenarios(rig, SHARES[options.share])
    elif options.part == 'exact':
        run_exact(rig, options)
    elif options.part not in ('all', 'storm'):
        run_scenarios(rig, GROUPS, options.part)
    else:
        for number in range(math.ceil(options.duration / _ROUND)):
            if options.part == 'all':
                run_exact(rig, options)
            run_storm(rig, min(_ROUND, options.duration - number * _ROUND),
                      f'{options.seed} {number}', options.busy)


def run_exact(rig: Rig, options: Namespace) -> None:
    """Run the exact part, its shares side by side since they mostly wait; add their results."""
    rig.table.runs['exact'] += 1
    shares = []
    for number in range(len(SHARES)):
        name = f"exact_{rig.table.runs['exact']}_{number}"
        shares.append(rig.child(name, [
            sys.executable, '-m', __package__, '--share', str(number), '--keep', rig.path(name),
            '--until', options.until, '--bridge', options.bridge], stderr=sys.stderr.fileno()))

    def over() -> bool:
        statuses = [each.process.poll() for each in shares]
        return None not in statuses or _STOPPED in statuses
    try:
        rig.wait(over, 'the exact part ends', math.inf)
    finally:
        for each in shares:
            each.ask_to_end()
        for each in shares:
            rig.end(each, grace=_GRACE)
            rig.table.add(Path(each.log).read_text())
    for each in shares:
        if each.process.returncode == _STOPPED:
            raise KeyboardInterrupt
        if each.process.returncode not in (0, 1):
            raise each.fault()


def run_scenarios(rig: Rig, groups: Sequence[Group], only: str = '') -> None:
    """Run all scenarios of these groups, or those with `only` in their names."""
    rig.table.part = 'exact'
    for group in groups:
        scenarios = [each for each in group.scenarios if only in name_of(each)]
        if not scenarios:
            continue
        with _lines(rig, group.line):
            rig.start(group.parameters)
            first = rig.bridge_number
            for scenario in scenarios:
                carry_out(rig, scenario)
        if len(scenarios) == len(group.scenarios):
            rig.logs.check_events(range(first, rig.bridge_number + 1), group.events)


def run_storm(rig: Rig, duration: float, seed: str, busy: int) -> None:
    """One half on serial lines, the other half with the boards behind networks."""
    rig.table.part = 'storm'
    for line in SerialLine, NetworkLine:
        with _lines(rig, line):
            _carry_out_once(rig, Storm(rig, duration / 2, f'{seed} {rig.is_network}', busy))
    rig.table.runs['storm'] += duration / 60


@contextlib.contextmanager
def _lines(rig: Rig, line: Type[SerialLine]) -> Iterator[None]:
    """New boards at the usual lines, or behind networks, and at the end no bridge."""
    before = rig.lines
    rig.use_lines(before if line is SerialLine else
                  {name: line(rig.path(name)) for name in NAMES})
    yield
    rig.end_bridge()
    rig.use_lines(before)


def name_of(scenario: Scenario) -> str:
    return f"{scenario.__module__.rpartition('.')[2]}.{scenario.__name__}"


def carry_out(rig: Rig, scenario: Scenario) -> None:
    """Run a scenario of the exact part; again if a check was not decided, or if something was
    violated and the machine stalled. The results of the last try count."""
    table = rig.table
    for left in reversed(range(_TRIES)):
        began, before = time.monotonic(), table.results()
        _carry_out_once(rig, scenario)
        spoiled = table.grown('undecided', before)
        violated = table.grown('violations', before)
        if violated:
            spoiled = violated if rig.machine.stalled(began, time.monotonic()) else []
        if not spoiled or not left:
            break
        print(*[f'    spoiled by the machine: {row.text} {row.examples}' for row in spoiled],
              sep='\n', file=sys.stderr)
        table.take_back(before)
    if table.until in [row.text for row in table.violated]:
        raise KeyboardInterrupt


def _carry_out_once(rig: Rig, scenario: Scenario) -> None:
    """Begins with quiet lines. After an exception, which is a violation, there is a new bridge."""
    name = name_of(scenario)
    print(f'{name} ...', file=sys.stderr)
    began, error_text = time.monotonic(), ''
    try:
        if rig.table.part == 'exact':       # the storm starts its own bridge
            rig.settle()
        scenario(rig)
    except Exception as error:  # pylint: disable=broad-except
        error_text = f'{type(error).__name__}: {error}'
    rig.row('every scenario runs to its end').check(
        not error_text, f'{name}: {error_text}')
    print(f'    {name}: {time.monotonic() - began:.1f} s {error_text}', file=sys.stderr)
    if error_text:
        rig.restore()
    rig.check_always()
