"""The bench; arguments.py says what it does."""
import json
import os
import platform
import signal
import sys
from argparse import Namespace

import psutil

from serial_communication.output import prepare_output
from .processes import StageError
from .report import judge, render
from .sections import SECTIONS, Plan
from .stage import BenchStage


def main(options: Namespace) -> int:
    """Run the bench with the options of arguments.py and return the exit status."""
    prepare_output()
    plan = Plan(1.0, 2, 2) if options.short else Plan(6.0, 4, 10)
    signal.signal(signal.SIGTERM, signal.default_int_handler)    # the children end
    before, load = psutil.cpu_times(), os.getloadavg()[0]
    try:
        results = {}
        with BenchStage(options.against) as stage:
            for name in options.only:
                print(f'{name} ...', file=sys.stderr)
                results[name] = SECTIONS[name](stage, plan)
                stage.clear()
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
            json.dump({'facts': facts, 'goals': judge(results, options.against),
                       'results': results}, file, indent=1)
    return 0
