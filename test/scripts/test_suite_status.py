"""The exit status and last line of scripts/test, in a temporary checkout with a few parts."""
import json
import os
import shutil
import signal
import socket
import subprocess
from pathlib import Path

import pytest
from waiting import PATIENCE, until

CHECKOUT = Path(__file__).resolve().parents[2]
# Replaces scripts/environment.bash, which installs and builds.
ENVIRONMENT = """
checkout=$(dirname "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")")
build=$checkout/build
set_up() { PYTHONPATH=; }
"""
GREEN = 'def test_green():\n    pass\n'
RED = 'def test_red():\n    assert False\n'
LONG = """
import os, pathlib, time
def test_long():
    pathlib.Path(__file__).with_name('pid').write_text(str(os.getpid()))
    time.sleep(600)
"""
SAVES_ENVIRONMENT = """
import json, os, pathlib
def test_saves():
    pathlib.Path(__file__).with_name('environment').write_text(json.dumps(dict(os.environ)))
"""

SEES = """
import errno, json, os, pathlib, socket
def test_sees():
    with socket.socket() as client:
        refused = client.connect_ex(('127.0.0.1', {})) == errno.ECONNREFUSED
    pathlib.Path(__file__).with_name('seen').write_text(json.dumps(
        dict(device=os.stat('/dev/pts').st_dev, refused=refused)))
"""


@pytest.fixture(name='suite')
def fixture_suite(tmp_path):
    """A function that starts scripts/test on the given tests; the fixture ends it."""
    checkout = tmp_path / 'checkout'
    for name in ('.ci/run', 'scripts/test', 'test/scripts/apart.py', 'test/scripts/results.py',
                 'test/pytest.ini'):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(str(CHECKOUT / name), str(checkout / name))
    (checkout / 'scripts/environment.bash').write_text(ENVIRONMENT)
    started = []

    def start(program='scripts/test', environment=None, **tests):
        for part, text in tests.items():
            if text is None:
                continue
            (checkout / 'test' / part).mkdir(exist_ok=True)
            (checkout / 'test' / part / 'test_it.py').write_text(text)
        started.append(subprocess.Popen(
            ['bash', str(checkout / program), *tests], env=environment, text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize('tests, status, last', [
    ({'framing': GREEN}, 0, '1 passed, 0 failed'),
    ({'framing': GREEN, 'link': GREEN, 'fuzz': GREEN}, 0, '3 passed, 0 failed'),
    ({'framing': GREEN, 'link': RED}, 1, '1 passed, 1 failed'),
    ({'framing': ''}, 1, '0 passed, 1 failed'),
], ids=['green', 'three green', 'one red', 'no test'])
def test_the_status_is_that_of_the_tests(suite, tests, status, last):
    process = suite(**tests)
    said = process.communicate(timeout=PATIENCE)[0]
    assert said.splitlines()[-1] == last
    assert process.returncode == status


def test_each_folder_of_a_part_is_a_process_without_a_conftest_above_the_checkout(suite, tmp_path):
    (tmp_path / 'conftest.py').write_text('import no_module_of_this_name\n')
    below = tmp_path / 'checkout/test/boards/below'
    below.mkdir(parents=True)
    (below / 'test_it.py').write_text(GREEN)    # in one process, two files of one name clash
    said = suite(boards=GREEN).communicate(timeout=PATIENCE)[0]
    assert {line.split()[1] for line in said.splitlines() if line.startswith('==> ')} == {
        'boards', 'boards-below'}
    assert said.splitlines()[-1] == '2 passed, 0 failed'


def test_quick_leaves_out_slow_tests_and_parts_that_need_ros(suite, tmp_path):
    parts = subprocess.check_output(
        ['bash', '-c', '. <(sed -n "/^quick=/,/)$/p" "$0"); echo "${quick[*]}"',
         str(CHECKOUT / 'scripts/test')], text=True).split()
    assert 'link' in parts and not set(parts) & {
        'ros', 'panel', 'firmware', 'docs', 'exact', 'soak'}
    for part in [*parts, 'panel']:
        (tmp_path / 'checkout/test' / part).mkdir()
        (tmp_path / 'checkout/test' / part / 'test_it.py').write_text(GREEN)
    (tmp_path / 'checkout/test/link/test_slow.py').write_text(
        'import pytest\npytestmark = pytest.mark.slow\n' + RED)
    (tmp_path / 'checkout/test/panel/test_it.py').write_text(RED)
    process = suite(quick=None)
    said = process.communicate(timeout=PATIENCE)[0]
    assert said.splitlines()[-1] == f'{len(parts)} passed, 0 failed'


@pytest.mark.parametrize('home', [{'HOME': '/home/somebody'}, {}], ids=['home', 'no home'])
def test_continuous_integration_uses_no_variable_of_this_machine(suite, tmp_path, home):
    process = suite('.ci/run', {'PATH': os.environ['PATH'], 'PYTHONUNBUFFERED': '1',
                                'ANYTHING': 'else', **home}, framing=SAVES_ENVIRONMENT)
    said = process.communicate(timeout=PATIENCE)[0]
    assert said.splitlines()[-1] == '1 passed, 0 failed'
    seen = json.loads((tmp_path / 'checkout/test/framing/environment').read_text())
    assert os.path.isabs(seen['HOME']) and seen['HOME'] == home.get('HOME', seen['HOME'])
    assert seen['TERM'] and seen['LANG'] == 'C.UTF-8' and '/usr/bin' in seen['PATH'].split(':')
    assert not {'PYTHONUNBUFFERED', 'ANYTHING'} & set(seen)


def test_each_program_has_its_own_ports_and_pseudo_terminals_if_the_system_allows_it(
        suite, tmp_path):
    device = os.stat('/dev/pts').st_dev
    allowed = int(subprocess.check_output(
        ['/usr/bin/python3', str(CHECKOUT / 'test/scripts/apart.py'),
         'stat', '-c', '%d', '/dev/pts'])) != device
    with socket.create_server(('127.0.0.1', 0)) as server:
        said = suite(link=SEES.format(server.getsockname()[1])).communicate(timeout=PATIENCE)[0]
    assert said.splitlines()[-1] == '1 passed, 0 failed'
    seen = json.loads((tmp_path / 'checkout/test/link/seen').read_text())
    assert [seen['device'] != device, seen['refused']] == [allowed, allowed]


@pytest.mark.parametrize('sent, status', [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_the_running_tests(suite, tmp_path, sent, status):
    process = suite(link=LONG)
    pid = tmp_path / 'checkout/test/link/pid'
    until(lambda: pid.exists() and pid.read_text(), 'the test runs')
    process.send_signal(sent)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == status
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
