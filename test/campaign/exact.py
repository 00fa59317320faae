"""The exact part: one event at a time, on lines that are quiet before it.

It starts three bridges: one for most scenarios, one that polls, one with a car behind a network.
"""
import signal
import sys
import time
from typing import Iterable

from . import exact_bus, exact_car, exact_node, exact_sensors
from .boards import Car
from .exact_node import End
from .lines import NetworkLine
from .rig import QUIET_CAR, MachineTooBusy, Rig, Scenario

FIRST = (*exact_bus.SCENARIOS, *exact_car.SCENARIOS, *exact_sensors.SCENARIOS,
         *exact_node.SCENARIOS)
SECOND = exact_node.killed, exact_bus.polls, End(signal.SIGINT, hang=False)
THIRD = exact_node.network, End(signal.SIGTERM, hang=True)
_ATTEMPTS = 3


def run(rig: Rig, only: str = '') -> None:
    """Run all scenarios, or those with `only` in their names, with the bridges that they need."""
    first = [scenario for scenario in FIRST if only in name_of(scenario)]
    second, third = (
        scenarios if any(only in name_of(scenario) for scenario in scenarios) else ()
        for scenarios in (SECOND, THIRD))
    if first or second:
        rig.start(QUIET_CAR)
        carry_out(rig, (*first, *second))
        rig.end_bridge()
    if third:
        car_line, car = rig.car_line, rig.car
        rig.car_line = NetworkLine(rig.path('network'))
        rig.car = Car(rig.car_line)
        rig.start()
        carry_out(rig, third)
        rig.end_bridge()
        rig.car_line, rig.car = car_line, car


def name_of(scenario: Scenario) -> str:
    return f"{scenario.__module__.rpartition('.')[2]}.{scenario.__name__}"


def carry_out(rig: Rig, scenarios: Iterable[Scenario]) -> None:
    """Run them one after the other. After an exception, a violation, the next has a new bridge."""
    required = rig.require('campaign', 'every scenario runs to its end')
    for scenario in scenarios:
        print(f'{name_of(scenario)} ...', file=sys.stderr)
        began = time.monotonic()
        error_text = _attempt(rig, scenario)
        required.check(not error_text, f'{name_of(scenario)}: {error_text}')
        print(f'    {time.monotonic() - began:.1f} s {error_text}', file=sys.stderr)
        if error_text:
            rig.restore()


def _attempt(rig: Rig, scenario: Scenario) -> str:
    """Run it, several times if the machine is too busy; return what failed, or ''."""
    repeated = rig.require('campaign', 'scenarios repeated, since the machine was too busy', True)
    for _ in range(_ATTEMPTS):
        try:
            scenario(rig)
            return ''
        except MachineTooBusy:
            repeated.checks += 1
        except Exception as error:  # pylint: disable=broad-except
            return f'{type(error).__name__}: {error}'
    return f'the machine was too busy {_ATTEMPTS} times'
