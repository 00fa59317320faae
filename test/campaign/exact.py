"""The exact part: one event at a time, on lines that are quiet before it."""
import signal
import sys
import time
from typing import Any, Dict, Iterable, NamedTuple, Tuple

from . import exact_bus, exact_car, exact_node, exact_sensors
from .lines import NetworkLine
from .rig import Rig, Scenario


def network_end(rig: Rig) -> None:
    exact_node.end(rig, signal.SIGTERM, hang=False)


class Group(NamedTuple):
    """Scenarios with one bridge.

    Args:
        events: patterns; the log of that bridge has to have a line for each, if all were run.
    """

    scenarios: Tuple[Scenario, ...]
    parameters: Dict[str, Any] = {}
    network: bool = False       # whether car and bus are behind a network
    events: Tuple[str, ...] = ()


GROUPS = (
    Group((*exact_bus.SCENARIOS, *exact_car.SCENARIOS, *exact_sensors.SCENARIOS,
           *exact_node.SCENARIOS), events=(
        'arduino: speed \\d+ refused: .*clos', 'arduino: speed \\d+ refused: its stamp',
        'arduino: .* refused: .*latches', 'arduino: .* refused: .*old connection',
        'arduino: .* refused: .*calibrates', 'arduino: LED .*refused', 'arduino: .*stalled for',
        'arduino: no speed command for 0.5 s', 'arduino: speed 5000 is out of range',
        'arduino: the port takes no data', 'arduino: the port closed while the car may',
        'arduino: .*announces hoist_70, gauge_71', 'arduino: .*winch.* left out',
        'arduino: framing', 'arduino: length', 'arduino: unknown type', 'arduino: implausible',
        'arduino: oversize', 'mcu: checksum', 'mcu: framing', 'mcu: length', 'bus: checksum',
        'bus: out of step', 'bus: no reply to', 'bus: the board does not answer ECHO',
        'mcu: .*silent', 'mcu: .* back', '(?s)open.*open.*open')),
    Group((exact_node.killed,)),
    Group((exact_bus.polls, exact_bus.announced), exact_node.POLLING),
    Group((exact_node.ends,)),
    Group((exact_node.network, exact_bus.frozen, exact_node.network_stall, network_end),
          network=True))


def run(rig: Rig, only: str = '') -> None:
    """Run all scenarios, or those with `only` in their names."""
    if not only:
        rig.table.has_run('exact')
    for group in GROUPS:
        scenarios = [each for each in group.scenarios if only in name_of(each)]
        if not scenarios:
            continue
        before = rig.bus_line, rig.car_line
        if group.network:
            rig.use_lines(*(NetworkLine(rig.path(name)) for name in ('bus', 'arduino')))
        rig.start(group.parameters)
        name = rig.bridge_name
        carry_out(rig, scenarios)
        rig.end_bridge()
        if len(scenarios) == len(group.scenarios):
            rig.logs.check_events(name, group.events)
        if group.network:
            rig.use_lines(*before)


def name_of(scenario: Scenario) -> str:
    return f"{scenario.__module__.rpartition('.')[2]}.{scenario.__name__}"


def carry_out(rig: Rig, scenarios: Iterable[Scenario]) -> None:
    """Run them one after the other. After an exception, a violation, the next has a new bridge."""
    required = rig.row('every scenario runs to its end')
    for scenario in scenarios:
        print(f'{name_of(scenario)} ...', file=sys.stderr)
        began, used, error_text = time.monotonic(), time.process_time(), ''
        try:
            scenario(rig)
        except Exception as error:  # pylint: disable=broad-except
            error_text = f'{type(error).__name__}: {error}'
        required.check(not error_text, f'{name_of(scenario)}: {error_text}')
        print(f'    {time.monotonic() - began:.1f} s, {time.process_time() - used:.1f} s of CPU '
              f'time {error_text}', file=sys.stderr)
        if error_text:
            rig.restore()
        rig.check_always()
