"""Runs the campaign on each broken bridge, until its requirement is violated; prints the seconds.

The exit status is 0 only if each was found by its requirement, and every change still applies.
"""
import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Optional, Tuple

from serial_communication.output import prepare_output
from . import PACKAGE, Broken, all_broken

_NODE = f"{sys.executable} -c 'from serial_communication.ros.node import main; main()'"
_APART = Path(__file__).parents[2] / 'scripts' / 'apart.py'
_AT_ONCE = 3     # they mostly wait
_TIME = 400      # s that one of them may take at most: four tries
_RUNS = 3        # at most, if the machine spoiled each try


def main() -> int:
    prepare_output()
    parser = argparse.ArgumentParser(
        prog='soak --broken', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('names', nargs='*', metavar='NAME', help='run these only')
    names = parser.parse_args().names
    chosen = [each for each in all_broken() if not names or each.name in names]
    if len(chosen) < len(names):
        parser.error(f'not all of these are broken bridges: {" ".join(names)}')
    missed = []
    with ThreadPool(_AT_ONCE) as pool:
        for each, (found, text) in zip(chosen, pool.imap(_run, chosen)):
            print(f'{each.name:27} {text}', flush=True)
            missed += [] if found else [each.name]
    print(f'{len(chosen) - len(missed)} of {len(chosen)} found', *missed)
    return int(bool(missed))


def _run(broken: Broken) -> Tuple[bool, str]:
    """Return whether it was found as it should be, and a text about it."""
    for _ in range(_RUNS):
        with tempfile.TemporaryDirectory(prefix='serial_communication_broken_') as folder:
            found, text = _run_once(broken, Path(folder))
        if found is not None:
            break
    return bool(found), text


def _run_once(broken: Broken, folder: Path) -> Tuple[Optional[bool], str]:
    """The same; None if the machine spoiled each try."""
    try:
        files = broken.files()
    except ValueError as error:
        return False, f'DOES NOT APPLY: {error}'
    shutil.copytree(str(PACKAGE), str(folder / PACKAGE.name))
    for path, text in files.items():
        (folder / PACKAGE.name / path).write_text(text)
    env = f'env PYTHONPATH={folder}:{os.environ["PYTHONPATH"]} '
    done = subprocess.run(
        ['setpriv', '--pdeathsig', 'TERM',      # it ends with this program, however that ends
         'timeout', '--foreground', '-k', '10', str(_TIME),
         sys.executable, str(_APART), sys.executable, '-m', 'campaign',
         '--keep', str(folder / 'records'), '--bridge', env + _NODE,
         '--part', broken.scenario, '--until', broken.requirement],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True, check=False)
    violated = re.findall('^VIOLATED after (.*?)  (.*)$', done.stdout, re.MULTILINE)
    for seconds, row in violated:
        if row.endswith(f': {broken.requirement}'):
            return True, f'{seconds:>8}  {broken.requirement}'
    if ' requirements, ' not in done.stdout:
        return False, f'the campaign does not run: {done.stdout[-500:]}'
    if f'spoiled by the machine: {broken.requirement}' in done.stdout:
        return None, f'NOT FOUND, since the machine stalled: {broken.what}'
    return False, f'NOT FOUND: {broken.what} Violated: {violated or "nothing"}'


try:
    sys.exit(main())
except KeyboardInterrupt:       # the campaigns get it, too
    sys.exit('stopped')
