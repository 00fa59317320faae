"""The first run: packages, password, progress, Ctrl-C, other systems and full disks."""
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
from terminal import Terminal

ENVIRONMENT = Path(__file__).resolve().parents[2] / 'scripts' / 'environment.bash'
NO_SPACE = 'demo: no space left on {}: make room (df -h, df -i), then try again.\n'


@pytest.fixture(name='folder')
def fixture_folder():
    """A folder that every user may use, with a copy of environment.bash and a folder `bin`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for each in ('scripts', 'bin', 'temporary'):
            (folder / each).mkdir()
        shutil.copy(str(ENVIRONMENT), str(folder / 'scripts'))
        for each in folder, folder / 'temporary':
            each.chmod(0o777)
        program(folder, 'sudo', '[[ $1 != -n ]] || shift; "$@"')    # the real one has its own PATH
        yield folder


def program(folder, name, text):
    """Put a program in place of a system's one."""
    path = folder / 'bin' / name
    path.write_text('#!/bin/bash\n' + text)
    path.chmod(0o755)


def script(folder, text, *prefix):
    """The command that sources environment.bash and runs a text."""
    set_up = f'cd {folder}; set -euo pipefail; . scripts/environment.bash; '
    return [*prefix, '/bin/bash', '-c', set_up + text, 'demo']


def environment(folder):
    return {'PATH': f'{folder}/bin:{os.environ["PATH"]}', 'TMPDIR': str(folder / 'temporary')}


def run(folder, text):
    return subprocess.run(script(folder, text), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, universal_newlines=True, timeout=60,
                          env={**os.environ, **environment(folder)})


def screen(terminal):
    """The lines that a terminal shows."""
    lines = ['']
    column = 0
    output = re.sub(r'\x1b\[[0-9;?]*[a-zA-JL-Z]', '', terminal._output.decode())
    for part in re.findall(r'\x1b\[K|.', output, re.DOTALL):
        if part == '\n':
            lines.append('')
        elif part == '\r':
            column = 0
        elif part == '\x1b[K':
            lines[-1] = lines[-1][:column]
        else:
            lines[-1] = lines[-1][:column].ljust(column) + part + lines[-1][column + 1:]
            column += 1
    return lines


APT = r'''echo "$@" >>asked; printf 'Unpacking ros-core (1.0) ...\r\n'
until [[ -e finish ]]; do sleep 0.1; done; touch finished'''


@pytest.fixture(name='terminal')
def fixture_terminal(folder):
    """A function that runs a text in a terminal."""
    started = []

    def start(text, *prefix):
        started.append(Terminal(script(folder, text, *prefix), **environment(folder)))
        return started[-1]
    yield start
    (folder / 'finish').touch()
    for each in started:
        each.close()


@pytest.mark.parametrize('name, step', [
    ('apt-get', 'install a-package'), ('cmake', 'build_inputs() { echo; }; build_if_changed')])
def test_the_last_line_of_apt_and_of_the_build_stays_on_the_screen(folder, terminal, name, step):
    program(folder, name, APT)
    program(folder, 'make', '')
    shown = terminal(f'{step}; echo "the next step"')
    shown.until(lambda: shown._output.endswith(b'\x1b[K\r'), 'progress')
    assert screen(shown)[1:] == ['    Unpacking ros-core (1.0) ...']
    (folder / 'finish').touch()
    shown.wait()
    assert screen(shown)[1:] == ['the next step', '']
    assert list((folder / 'temporary').iterdir()) == []


def test_ctrl_c_during_the_packages_ends_the_program_when_apt_has_finished(folder, terminal):
    program(folder, 'apt-get', APT)
    shown = terminal("trap 'exit 130' INT USR1; install a-package; echo 'the next step'")
    shown.until(lambda: 'Unpacking' in shown.text(), 'apt-get runs')
    shown.press(b'\3')
    shown.until(lambda: any(row.endswith('==> Ctrl-C: apt-get finishes first, then demo ends ...')
                            for row in screen(shown)), 'the line about Ctrl-C')
    shown.press(b'\3')
    (folder / 'finish').touch()
    shown.wait()
    assert (folder / 'finished').exists() and 'the next step' not in shown.text()
    assert shown.text().count('finishes first') == 1
    assert shown.status == 130
    assert list((folder / 'temporary').iterdir()) == []


def test_a_line_before_the_password_says_what_it_is_for(folder, terminal):
    program(folder, 'apt-get', 'echo "$@" >>asked')
    program(folder, 'sudo', '''case $1 in
        -v) echo "[sudo] password for me:"; touch known ;;
        *) [[ $1 == -n && -e known ]] && shift && "$@" ;;
    esac''')
    ordinary = [] if os.geteuid() else ['/usr/bin/setpriv', '--reuid=65534', '--regid=65534',
                                        '--clear-groups']
    shown = terminal('install a-package', *ordinary)
    shown.wait()
    assert shown.status == 0, shown.text()
    assert screen(shown)[:2] == [
        '==> Packages are missing. To install them, sudo asks for your password:',
        '[sudo] password for me:']
    assert 'a-package' in (folder / 'asked').read_text()


def test_the_package_lists_are_fetched_if_a_package_is_not_in_them(folder):
    program(folder, 'apt-get', '''echo "$@" >>asked; [[ $* != *update ]] || touch lists
        [[ -e lists ]]''')
    done = run(folder, 'install a-package; echo ready')
    assert done.stdout.splitlines()[-1] == 'ready' and done.stderr == ''
    asked = (folder / 'asked').read_text().splitlines()
    assert [line.split()[-1] for line in asked] == ['a-package', 'update', 'a-package']


def test_another_system_gets_the_command_for_a_container(folder):
    done = run(folder, 'noetic=/nowhere; is_debian_12() { false; }; checkout="/home/my name/b"; '
               'set_up run')
    assert done.returncode == 1
    line, = done.stderr.splitlines()
    assert line.startswith('demo: this system is neither Debian 12 nor one with /nowhere. ')
    assert line.endswith('docker run -it --network host -v /home/my\\ name/b:/bridge debian:12 '
                         '/bridge/scripts/demo')


CMAKE = '''for line in {1..30}; do echo "CMake Error at line $line"; done
echo "file: No space left on device"; exit 1'''


def test_logs_over_a_week_old_are_deleted_whatever_is_beside_them(folder):
    """A folder is not written any more while the logs in it still grow."""
    for name in 'old/node.log', 'mixed/old.log', 'mixed/new.log', 'new/node.log':
        path = folder / 'log' / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    for name in 'old/node.log', 'mixed/old.log', 'old', 'mixed':
        os.utime(str(folder / 'log' / name), (0, 0))
    done = run(folder, f'export ROS_LOG_DIR={folder}/log; delete_old_logs; echo done')
    assert (done.stdout, done.stderr) == ('done\n', '')
    assert sorted(str(path.relative_to(folder / 'log')) for path in folder.glob('log/*/*')) == [
        'mixed/new.log', 'new/node.log']


def test_a_full_disk_during_the_build_is_one_line(folder):
    program(folder, 'cmake', CMAKE)
    done = run(folder, 'build_inputs() { echo; }; build_if_changed')
    assert done.returncode == 1 and done.stderr == NO_SPACE.format('a disk')
    program(folder, 'cmake', CMAKE.replace('No space left on device', 'syntax error'))
    done = run(folder, 'build_inputs() { echo; }; build_if_changed')
    assert done.returncode == 1 and 'syntax error\ndemo: the build failed' in done.stderr
