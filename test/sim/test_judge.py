"""The judge: robots in virtual time, whose seeds decide all that happens to them."""
import os
import random
import re
import subprocess
import sys
from pathlib import Path

import judge
import pytest
from invariants import ALL
from mutants import MUTANTS, SEEDS, broken_by

PAGE = Path(__file__).resolve().parents[2] / 'doc' / 'safety.md'

_FIXED = 160        # seeds
# What the judge has found in the bridge, by the seed that showed it.
FOUND = {
    63: 'a stop of a function that is announced no longer was not sent, and ended what was '
        'outstanding all the same',
    149: 'every reading of the environment counted as an implausible error',
    2026116928: 'the first time of a board was damaged, and made the stamps after it 17 ms early'}
_DIGEST = '''
import hashlib, sys
sys.path[:0] = [{folder!r}]
import judge
from life import live
digest = hashlib.sha256()
for seed in range(6):
    for story in live(seed):
        digest.update(repr((story.device.bridge_wrote, story.device.bridge_read,
                            story.robot.published)).encode())
print(digest.hexdigest())
'''


def broken(seed):
    """What one seed has found."""
    return [f'seed {seed}: {name}: {words}' for name, words in judge.run(seed).broken.items()]


@pytest.mark.parametrize('first', range(0, _FIXED, 20))
def test_the_bridge_keeps_its_promises(first):
    assert [each for seed in range(first, first + 20) for each in broken(seed)] == []


@pytest.mark.parametrize('seed', FOUND)
def test_what_was_found_is_mended(seed):
    assert broken(seed) == []


def test_a_fresh_seed_is_tried_and_only_reported():
    for words in broken(random.randrange(10 ** 9)):
        print(words, file=sys.stderr)


def test_a_seed_gives_the_same_bytes_in_every_process():
    said = {subprocess.run(
        [sys.executable, '-c', _DIGEST.format(folder=os.path.dirname(judge.__file__))], text=True,
        stdout=subprocess.PIPE, env={**os.environ, 'PYTHONHASHSEED': seed}, check=True).stdout
        for seed in ('1', '2')}
    assert len(said) == 1


@pytest.mark.parametrize('name', MUTANTS)
def test_a_broken_promise_is_found(name):
    with broken_by(name):
        assert broken(SEEDS[name])


def test_the_page_lists_the_promises():
    listed = PAGE.read_text().partition('### The car')[2].partition('### The node')[0]
    items = [' '.join(item.split()) for item in re.findall(r'^- ((?:.|\n  )*)', listed, re.M)]
    assert items == [' '.join(each.__doc__.split()).rstrip('.') for each in ALL]
