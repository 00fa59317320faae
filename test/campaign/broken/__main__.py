"""Runs the campaign on each broken bridge, and prints which requirement found it after how long.

The exit status is 0 only if all were found. A bridge that the campaign cannot start counts as not
found: it shows nothing about the requirements.
"""
import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Optional

from serial_communication.output import prepare_output
from . import PACKAGE, Broken, all_broken

_NODE = f"{sys.executable} -c 'from serial_communication.ros.node import main; main()'"
_TIME = 300      # s that one of them may take at most


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
    for each in chosen:
        with tempfile.TemporaryDirectory(prefix='serial_communication_broken_') as folder:
            found = _run(each, Path(folder))
        print(f'{each.name:27} {found or "NOT FOUND: " + each.what}', flush=True)
        missed += [] if found else [each.name]
    print(f'{len(chosen) - len(missed)} of {len(chosen)} found', *missed)
    return int(bool(missed))


def _run(broken: Broken, folder: Path) -> Optional[str]:
    """Return which requirement was violated first, and when; None: none was."""
    shutil.copytree(str(PACKAGE), str(folder / PACKAGE.name))
    for path, text in broken.files().items():
        (folder / PACKAGE.name / path).write_text(text)
    result = folder / 'result.json'
    env = f'env PYTHONPATH={folder}:{os.environ["PYTHONPATH"]} '
    arguments = [sys.executable, '-m', 'campaign', '--json', str(result), '--keep',
                 str(folder / 'records'), '--bridge', env + _NODE, '--part', broken.part]
    with open(str(folder / 'output'), 'w+') as output:
        subprocess.run(['timeout', str(_TIME), *arguments], stdout=output, stderr=output,
                       check=False)
        output.seek(0)
        if not result.exists():
            print(f'{broken.name}: the campaign does not run:', output.read()[-500:])
            return None
    # That a scenario failed is only the consequence.
    violated = sorted((row['group'] == 'campaign', row['violated after'], row['requirement'])
                      for row in json.loads(result.read_text()) if row['violations'])
    others = f' (and {len(violated) - 1} more)' if violated[1:] else ''
    return f'{violated[0][1]:6.1f} s  {violated[0][2]}{others}' if violated else None


sys.exit(main())
