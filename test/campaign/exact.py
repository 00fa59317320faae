"""The exact part: one event after the other, on lines that are quiet between them.

Three bridges live one after the other: the first one takes most of it and is killed; the second one
polls; the third one has its car behind a network.
"""
import signal
import sys
import time
from typing import Iterable

from . import exact_bus, exact_car, exact_node, exact_sensors
from .boards import Car
from .exact_node import Ends
from .field import Disturbed, Field, Scenario
from .lines import NetworkLine

FIRST = (*exact_bus.SCENARIOS, *exact_car.SCENARIOS, *exact_sensors.SCENARIOS,
         *exact_node.SCENARIOS)
_TRIES = 3
SECOND = exact_node.killed, exact_bus.polls, Ends(signal.SIGINT, hang=False)
THIRD = exact_node.network, Ends(signal.SIGTERM, hang=True)


def run(field: Field, only: str = '') -> None:
    """Every scenario, or those with `only` in their names; and the bridges that they need."""
    first = [scenario for scenario in FIRST if only in name_of(scenario)]
    second, third = (
        scenarios if any(only in name_of(scenario) for scenario in scenarios) else ()
        for scenarios in (SECOND, THIRD))
    if first or second:
        field.start()
        carry_out(field, (*first, *second))
        field.clear_bridge()
    if third:
        car_line, car = field.car_line, field.car
        field.car_line = NetworkLine(field.path('network'))
        field.car = Car(field.car_line)
        field.start()
        carry_out(field, third)
        field.clear_bridge()
        field.car_line, field.car = car_line, car


def name_of(scenario: Scenario) -> str:
    return f"{scenario.__module__.rpartition('.')[2]}.{scenario.__name__}"


def carry_out(field: Field, scenarios: Iterable[Scenario]) -> None:
    """One after the other. What ends one is a violation, and the next one has a bridge again."""
    row = field.row('campaign', 'every scenario can be carried out to its end')
    for scenario in scenarios:
        print(f'{name_of(scenario)} ...', file=sys.stderr)
        began = time.monotonic()
        trouble = _trouble_of(field, scenario)
        row.check(not trouble, f'{name_of(scenario)}: {trouble}')
        print(f'    {time.monotonic() - began:.1f} s {trouble}', file=sys.stderr)
        if trouble:
            field.mend()


def _trouble_of(field: Field, scenario: Scenario) -> str:
    again = field.row('campaign', 'scenarios begun anew: the machine gave the bridge no time', True)
    for _ in range(_TRIES):
        try:
            scenario(field)
            return ''
        except Disturbed:
            again.tries += 1
        except Exception as error:  # pylint: disable=broad-except
            return f'{type(error).__name__}: {error}'
    return 'this machine gave the bridge no time, each time'
