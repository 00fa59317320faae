"""Programs run with ROS's Python, whichever python3 is first on the PATH.

Debian's rosrun runs the files of a checkout directly. Another Python (of pyenv, conda or a virtual
environment) has neither rospy nor pyserial.
"""
import os
import subprocess

import pytest
from sources import ROOT, name, python_programs

_HIT = 'the wrong python3 was run'


def _python_executables():
    """Every executable Python file."""
    tests = [path for path in sorted((ROOT / 'test').rglob('*.py')) if os.access(path, os.X_OK)]
    return python_programs() + tests


def test_the_first_line_names_the_systems_python():
    programs = _python_executables()
    assert [name(path) for path in programs
            if path.read_text().split('\n', 1)[0] != '#!/usr/bin/python3'] == []
    assert {'serial_communication_node', 'simulator', 'monitor', 'bus_test.py'} <= {
        path.name for path in programs}


@pytest.mark.parametrize('path', python_programs(), ids=name)
def test_another_python3_first_on_the_path_is_not_run(path, tmp_path):
    fake = tmp_path / 'python3'
    fake.write_text(f'#!/bin/sh\necho "{_HIT}"\nexit 9\n')
    fake.chmod(0o755)
    done = subprocess.run(
        [str(path), '--help'], universal_newlines=True, timeout=60, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, 'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    assert _HIT not in done.stdout
    assert done.returncode == 0, done.stdout
    assert 'usage:' in done.stdout
