"""scripts/environment.bash: which packages of which system it installs, and with which ROS."""
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ENVIRONMENT = Path(__file__).resolve().parents[2] / 'scripts' / 'environment.bash'
APT_CACHE = '[[ -e lists && $2 != chromium ]]'
APT_GET = 'echo "${@:5}" >>asked; [[ $* != *update ]] || touch lists'


@pytest.fixture(name='folder')
def fixture_folder(tmp_path):
    """A folder with a copy of environment.bash, and with a package manager that only notes."""
    for each in ('scripts', 'bin'):
        (tmp_path / each).mkdir()
    shutil.copy(str(ENVIRONMENT), str(tmp_path / 'scripts'))
    for name, text in ('apt-cache', APT_CACHE), ('apt-get', APT_GET), ('sudo', '"$@"'):
        (tmp_path / 'bin' / name).write_text('#!/bin/bash\n' + text)
        (tmp_path / 'bin' / name).chmod(0o755)
    return tmp_path


def run(folder, text):
    """Source environment.bash and run a text."""
    set_up = 'set -euo pipefail; . scripts/environment.bash; '
    path = f'{folder}/bin:{os.environ["PATH"]}'
    return subprocess.run(['/bin/bash', '-c', set_up + text, 'demo'], cwd=folder, timeout=60,
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          text=True, env={**os.environ, 'PATH': path})


@pytest.mark.parametrize('distro, names', [
    (None, ['catkin', 'python3-serial', 'python3-tf2-ros', 'ros-core-python-dev']),
    ('noetic', ['python3-serial', 'ros-noetic-ros-core', 'ros-noetic-tf2-ros']),
    ('one', ['python3-serial', 'ros-one-ros-core', 'ros-one-tf2-ros'])])
def test_the_packages_have_the_names_of_the_ros_that_is_there(folder, distro, names):
    if distro:
        (folder / distro).mkdir()
        (folder / distro / 'setup.bash').touch()
    done = run(folder, 'prefixes=("$PWD/one" "$PWD/noetic"); needed_packages run')
    assert set(names) <= set(done.stdout.split()) and done.stderr == ''
    assert ('catkin' in done.stdout.split()) == (distro is None)


def test_the_setup_of_the_prefix_is_sourced(folder):
    (folder / 'one').mkdir()
    (folder / 'one' / 'setup.bash').write_text('echo "this is ${unset_variable}one"')
    done = run(folder, 'prefixes=("$PWD/one"); missing_packages() { :; }; '
                       'build_if_changed() { exit 0; }; set_up run')
    assert (done.stdout, done.stderr) == ('this is one\n', '')


def test_a_system_without_ros_gets_one_line_that_names_it_and_the_page(folder):
    (folder / 'bin' / 'apt-cache').write_text('#!/bin/bash\n[[ $2 != ros-core-python-dev ]]')
    done = run(folder, 'prefixes=(); install ros-core-python-dev socat')
    assert (done.returncode, done.stderr) == (
        1, f'demo: {system()} has no package ros-core-python-dev; see doc/install.md\n')
    assert (folder / 'asked').read_text() == 'update\n'


def system():
    """The name of this system."""
    return subprocess.check_output(['bash', '-c', '. /etc/os-release; echo "$PRETTY_NAME"'],
                                   text=True).strip()
