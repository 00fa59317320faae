"""Tests with the versions of Ubuntu 20.04: Python 3.8, pyserial 3.4, pytest 4.6.9, hypothesis
4.36.2. test_python_version also lists names that these versions lack.

A Python 3.8 is taken from SERIAL_COMMUNICATION_PYTHON38, the PATH or pyenv, and the packages from
the package index. Without them the tests are skipped.
"""
import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from sources import ROOT

VERSIONS = {'pyserial': '3.4', 'pytest': '4.6.9', 'hypothesis': '4.36.2'}
# Tests without a ROS node: all of COLLECTED are collected, and RUN, which uses these packages and
# takes less time, runs.
COLLECTED = ('boards', 'framing', 'kernel', 'link', 'sim', 'simulation', 'tools', 'transport')
RUN = [f'test/{each}' for each in (
    'kernel/test_port.py', 'transport/test_urls.py', 'boards/test_stream_decoders.py',
    'framing/test_custom_messages.py')]
pytestmark = pytest.mark.slow
_LONGEST = 600      # s; only a test that hangs takes so long


def is_python_3_8(program):
    """Whether a program is Python 3.8 and can make virtual environments."""
    try:
        said = subprocess.run(
            [program, '-c', 'import ensurepip, sys, venv; print(*sys.version_info[:2])'],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False).stdout
        return said == '3 8\n'
    except OSError:
        return False


def python_3_8():
    """Return the path of a Python 3.8, or None."""
    pyenv = Path(os.environ.get('PYENV_ROOT') or '~/.pyenv').expanduser()
    found = [os.environ.get('SERIAL_COMMUNICATION_PYTHON38'), shutil.which('python3.8'),
             *map(str, sorted(pyenv.glob('versions/3.8.*/bin/python3.8')))]
    return next((each for each in found if each and is_python_3_8(each)), None)


@pytest.fixture(scope='module', name='old_python')
def fixture_old_python(tmp_path_factory):
    """A Python 3.8 with these versions and, after them on its path, the ROS packages."""
    program = python_3_8()
    if not program:
        pytest.skip('no Python 3.8 with venv; SERIAL_COMMUNICATION_PYTHON38 may name one')
    folder = tmp_path_factory.mktemp('python3.8')
    python = str(folder / 'bin' / 'python')
    for command in ([program, '-m', 'venv', str(folder)],
                    [python, '-m', 'pip', 'install', '--quiet', '--disable-pip-version-check',
                     '--retries', '1', *('=='.join(each) for each in VERSIONS.items())]):
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                              stdin=subprocess.DEVNULL, check=False,
                              env={**os.environ, 'PYTHONPATH': ''})
        if done.returncode:
            pytest.skip('a Python 3.8 with %s cannot be set up: %s' % (
                ', '.join(VERSIONS), done.stdout.strip().rpartition('\n')[2]))
    behind = {str(Path(importlib.util.find_spec(name).origin).parents[1])
              for name in ('rosgraph', 'yaml')}
    site, = folder.glob('lib/python3.8/site-packages')
    (site / 'ros.pth').write_text('\n'.join(sorted(behind)) + '\n')
    return python


def run(python, *arguments):
    """Run pytest of that Python, which has to pass."""
    done = subprocess.run([python, '-m', 'pytest', '-q', '--tb=short', '-p', 'no:cacheprovider',
                           *arguments], cwd=str(ROOT), stdout=subprocess.PIPE, text=True,
                          stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, timeout=_LONGEST,
                          check=False, env={**os.environ,
                                            # of the system's pytest, which is newer
                                            'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1',
                                            'SERIAL_COMMUNICATION_FUZZ_EXAMPLES': '5'})
    assert done.returncode == 0, done.stdout


def test_the_versions_are_those_of_ubuntu(old_python):
    said = subprocess.check_output(
        [old_python, '-c', 'import hypothesis, pytest, serial\n'
         'print(serial.__version__, pytest.__version__, hypothesis.__version__)'], text=True)
    assert said.split() == list(VERSIONS.values())


def test_every_test_is_collected(old_python):
    run(old_python, '--collect-only', *(f'test/{part}' for part in COLLECTED))


def test_tests_of_these_packages_pass(old_python):
    run(old_python, *RUN)
