"""socat_pair: two connected ports, and protection of those in use."""
import os
import signal
import subprocess
from pathlib import Path

import pytest
from waiting import PATIENCE, until

SOCAT_PAIR = Path(__file__).resolve().parents[2] / 'scripts' / 'socat_pair'


@pytest.fixture(name='pair')
def fixture_pair(tmp_path):
    """A function that starts a pair with two names; the fixture ends it."""
    started = []

    def start(*names):
        started.append(subprocess.Popen([str(SOCAT_PAIR), *[str(tmp_path / name)
                                                            for name in names]],
                                        stderr=subprocess.PIPE, text=True))
        return started[-1]
    yield start
    for process in started:
        process.kill()
        process.communicate(timeout=PATIENCE)


def until_linked(folder, *names):
    until(lambda: all((folder / name).exists() for name in names), 'the links')
    return [os.readlink(str(folder / name)) for name in names]


def carries(folder, near, far):
    """Whether a byte written to one port is read from the other."""
    ends = [os.open(str(folder / name), os.O_RDWR | os.O_NOCTTY) for name in (near, far)]
    try:
        os.write(ends[0], b'x')
        return os.read(ends[1], 1) == b'x'
    finally:
        for end in ends:
            os.close(end)


@pytest.mark.parametrize('second', [('a', 'b'), ('b', 'a'), ('a', 'c'), ('c', 'b')])
def test_a_second_pair_with_a_name_in_use_is_refused(pair, tmp_path, second):
    first = pair('a', 'b')
    linked = until_linked(tmp_path, 'a', 'b')
    other = pair(*second)
    _, said = other.communicate(timeout=PATIENCE)
    assert other.returncode == 1
    taken = next(name for name in second if name != 'c')
    assert said == f'socat_pair: {tmp_path / taken} is in use by process {first.pid}; ' \
        'end it, or choose another path\n'
    assert until_linked(tmp_path, 'a', 'b') == linked and first.poll() is None
    assert carries(tmp_path, 'a', 'b')


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGKILL])
def test_the_names_are_free_after_the_pair_has_ended(pair, tmp_path, number):
    first = pair('a', 'b')
    until_linked(tmp_path, 'a', 'b')
    first.send_signal(number)
    first.wait(PATIENCE)
    pair('a', 'b')

    def carries_if_there():
        try:
            return carries(tmp_path, 'a', 'b')
        except OSError:
            return False      # not linked yet, or the first pair's links
    until(carries_if_there, 'a byte is transmitted')


def test_a_folder_that_it_created_is_removed_when_the_last_pair_in_it_ends(pair, tmp_path):
    folder = tmp_path / 'new'
    pairs = [pair('new/a', 'new/b')]
    until_linked(folder, 'a', 'b')
    pairs.append(pair('new/c', 'new/d'))
    until_linked(folder, 'c', 'd')
    pairs[0].terminate()
    until(lambda: not (folder / 'a.lock').exists(), 'its locks are removed')
    assert carries(folder, 'c', 'd')
    pairs[1].send_signal(signal.SIGINT)
    until(lambda: not folder.exists(), 'the folder is removed')


def test_a_folder_that_was_there_stays(pair, tmp_path):
    first = pair('a', 'b')
    until_linked(tmp_path, 'a', 'b')
    first.terminate()
    first.wait(PATIENCE)
    assert sorted(path.name for path in tmp_path.iterdir()) == ['a.lock', 'b.lock']


def test_a_path_that_is_not_a_link_is_not_changed(pair, tmp_path):
    (tmp_path / 'a').write_text('mine')
    process = pair('a', 'b')
    _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1 and 'is not a link' in said
    assert (tmp_path / 'a').read_text() == 'mine'


@pytest.mark.parametrize('plant', ['symlink', 'dangling', 'hard link', 'fifo'])
def test_a_planted_lock_file_is_not_opened(pair, tmp_path, plant):
    victim, lock = tmp_path / 'victim', tmp_path / 'b.lock'
    victim.write_text('mine')
    if plant == 'symlink':
        lock.symlink_to(victim)
    elif plant == 'dangling':
        lock.symlink_to(tmp_path / 'new')
    elif plant == 'hard link':
        os.link(str(victim), str(lock))
    else:
        os.mkfifo(str(lock))
    process = pair('a', 'b')
    _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert said == f'socat_pair: {lock} is a link or not a regular file, and may be another ' \
        'user\'s; remove it, or choose another path\n'
    assert victim.read_text() == 'mine' and not (tmp_path / 'new').exists()


def test_without_socat_it_reports_what_to_install(tmp_path):
    done = subprocess.run(['/bin/sh', str(SOCAT_PAIR), 'a', 'b'], stderr=subprocess.PIPE, text=True,
                          env={'PATH': str(tmp_path)}, timeout=PATIENCE)
    assert done.returncode == 1
    assert done.stderr.startswith('socat_pair: socat is missing; install it')
