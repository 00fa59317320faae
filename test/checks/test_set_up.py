"""scripts/environment.bash: which packages of which system it installs, and with which ROS."""
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ENVIRONMENT = Path(__file__).resolve().parents[2] / 'scripts' / 'environment.bash'
PROGRAMS = {'apt-cache': '[[ $2 != ros-core* && $2 != socat ]]', 'sudo': '"$@"',
            'apt-get': 'echo "${@:4}" >>asked'}


@pytest.fixture(name='run')
def fixture_run(tmp_path):
    """A function that sources a copy of environment.bash, beside a package manager that only
    notes what it is asked for, and runs a text."""
    for each in 'scripts', 'bin', 'noetic', 'one/share/tf2_ros':
        (tmp_path / each).mkdir(parents=True)
    shutil.copy(str(ENVIRONMENT), str(tmp_path / 'scripts'))
    (tmp_path / 'one' / 'setup.bash').write_text('echo "this is ${unset_variable}one"')
    (tmp_path / 'one' / 'share' / 'tf2_ros' / 'package.xml').touch()
    for name, text in PROGRAMS.items():
        (tmp_path / 'bin' / name).write_text('#!/bin/bash\n' + text)
        (tmp_path / 'bin' / name).chmod(0o755)
    return lambda text: subprocess.run(
        ['/bin/bash', '-c', 'set -euo pipefail; . scripts/environment.bash; ' + text, 'demo'],
        cwd=tmp_path, timeout=60, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PATH': f'{tmp_path}/bin:{os.environ["PATH"]}'})


@pytest.mark.parametrize('prefix, has, has_not', [
    ('', ['catkin', 'python3-serial', 'python3-tf2-ros', 'ros-core-python-dev'], 'ros-one-tf2-ros'),
    ('$PWD/noetic', ['python3-serial', 'ros-noetic-ros-core', 'ros-noetic-tf2-ros'], 'catkin'),
    ('$PWD/one', ['python3-serial', 'ros-one-ros-core'], 'ros-one-tf2-ros')])    # that is there
def test_the_packages_have_the_names_of_the_ros_that_is_there(run, prefix, has, has_not):
    done = run(f'needed_packages "{prefix}" run')
    assert set(has) <= set(done.stdout.split()) - {has_not} and done.stderr == ''
    assert has_not not in done.stdout.split()


def test_the_setup_of_the_prefix_is_sourced(run):
    done = run('prefixes=("$PWD/none" "$PWD/one"); missing_packages() { :; }; '
               'build_if_changed() { exit 0; }; set_up run')
    assert (done.stdout, done.stderr) == ('this is one\n', '')


@pytest.mark.parametrize('packages, status, asked', [
    ('ros-core-python-dev socat', 1, 'update'),      # a system without ROS
    ('socat cmake', 0, 'install -y --no-install-recommends cmake')])
def test_a_system_without_a_package_is_named_with_the_page(run, tmp_path, packages, status, asked):
    done = run('install ' + packages)
    assert done.returncode == status and 'doc/install.md' in done.stdout + done.stderr
    assert (tmp_path / 'asked').read_text().splitlines()[-1] == asked
