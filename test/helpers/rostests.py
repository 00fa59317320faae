"""A pytest plugin: each .test file is a test; rostest runs it with a ROS master of its own."""
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[2]


def pytest_collect_file(file_path, parent):
    return Rostest.from_parent(parent, path=file_path) if file_path.suffix == '.test' else None


class Rostest(pytest.File):
    """A .test file."""

    def collect(self):
        yield Run.from_parent(self, name=self.path.stem)


class RostestError(Exception):
    """What failed."""


class Run(pytest.Item):
    """A run of rostest; its output and results are kept in build/test_results."""

    def runtest(self):
        folder = ROOT / 'build' / 'test_results' / self.name
        folder.mkdir(parents=True)
        with (folder / 'log').open('w') as log:
            status = subprocess.run(
                [sys.executable, str(ROOT / 'test/helpers/apart.py'), 'rostest',
                 f'--results-base-dir={folder}', str(self.path)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT).returncode
        cases = [case for path in folder.rglob('*.xml')
                 for case in ElementTree.parse(str(path)).getroot().iter('testcase')]
        failed = [f'{case.get("name")}:\n{(each.text or each.get("message") or "").strip()}'
                  for case in cases for each in case if each.tag in ('failure', 'error')]
        if failed or status or not cases:
            raise RostestError('\n\n'.join([*failed, f'status {status}; see {folder / "log"}']))

    def repr_failure(self, excinfo, style=None):
        if isinstance(excinfo.value, RostestError):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self):
        return self.path, None, self.name
