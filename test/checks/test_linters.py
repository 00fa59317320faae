"""Linters for Python, shell, XML and catkin."""
import ast
import os
import re
import shutil
import subprocess
import sys

import pytest
from sources import PACKAGE, ROOT, name, python_files, shell_files

# Rules of catkin_lint that do not fit here:
IGNORED = (
    'package_path_name',      # the folder of a checkout may have any name
    'literal_project_name',   # the node's file has the package's name
    'uninstalled_script',     # programs of a checkout, see the test of what is installed
)


def run(*command, **environment) -> str:
    """Return a linter's output; if it fails, the test fails with that output."""
    if not shutil.which(str(command[0])):
        pytest.fail('%s is missing; scripts/test installs it' % command[0])
    done = subprocess.run([str(each) for each in command], cwd=str(ROOT), text=True,
                          env={**os.environ, **environment},
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if done.returncode:
        pytest.fail(done.stdout, pytrace=False)
    return done.stdout


def test_flake8_finds_nothing():
    # W503 and W504 contradict each other: operators may be before or after a line break.
    run(sys.executable, '-m', 'flake8', '--isolated', '--jobs=1', '--max-line-length=100',
        '--extend-ignore=W503,W504', *python_files())


def test_mypy_finds_nothing():
    # Ubuntu 20.04 has version 0.761, which reports errors where there are none.
    pytest.importorskip('mypy.version', '1.0')
    output = run(sys.executable, '-m', 'mypy', '--cache-dir', os.devnull,
                 '--config-file', ROOT / 'test' / 'checks' / 'mypy.ini')
    assert f'{len(list(PACKAGE.rglob("*.py")))} source files' in output


def test_shellcheck_finds_nothing():
    # SC2015: `a && b || fail` is correct where b is a test too.
    run('shellcheck', '--exclude=SC2015', '--external-sources', '--source-path', ROOT,
        *shell_files())


def test_xml_is_well_formed():
    run('xmllint', '--noout', ROOT / 'package.xml', *ROOT.glob('launch/**/*.launch*'),
        *ROOT.glob('config/*.urdf'), *ROOT.glob('test/ros/*.test'))


def test_systemd_accepts_the_boot_unit():
    assert run('systemd-analyze', 'verify', ROOT / 'config' / 'serial_communication.service') == ''


def test_catkin_lint_finds_nothing():
    run('catkin_lint', '-W2', '--strict', *['--ignore=' + rule for rule in IGNORED], ROOT,
        SERIAL_COMMUNICATION_VIEW='yes')     # the dependencies of view.launch count


@pytest.mark.slow
@pytest.mark.parametrize('arguments, bridge', [([], False), (['sim:=false'], False),
                                               (['sim:=true'], True), (['sim:=avr'], True)])
def test_view_starts_a_bridge_only_with_simulated_boards(arguments, bridge):
    nodes = run('roslaunch', '--nodes', 'serial_communication', 'view.launch', *arguments).split()
    assert {'/rviz', '/car_model'} <= set(nodes)
    assert ('/serial_communication' in nodes) == bridge


@pytest.mark.slow
@pytest.mark.parametrize('launch', sorted(path.name for path in ROOT.glob('launch/*.launch')))
def test_every_launch_argument_is_optional_and_documented(launch):
    said = run('roslaunch', '--ros-args', 'serial_communication', launch)
    assert 'Optional Arguments:' in said
    assert 'Required' not in said and 'undocumented' not in said, said


def test_robot_programs_are_installed():
    """The programs for a robot are installed; programs of a checkout are not."""
    cmake = (ROOT / 'CMakeLists.txt').read_text()
    programs = {path.name for path in (ROOT / 'scripts').iterdir() if os.access(path, os.X_OK)}
    assert programs - {'demo', 'soak', 'test'} == set(
        re.findall(r'^    scripts/(\S+)$', cmake, re.MULTILINE))


def test_no_file_needs_a_newer_syntax_than_that_of_python_3_8():
    """Ubuntu 20.04 has it."""
    for path in python_files():
        ast.parse(path.read_text(), name(path), feature_version=(3, 8))
