"""The first command of the README."""
import subprocess

import pytest
from sources import ROOT


@pytest.mark.slow
def test_the_demo_shows_all_boards_and_ends_by_itself():
    done = subprocess.run([str(ROOT / 'scripts' / 'demo'), '--duration', '10'], text=True,
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT)
    assert done.returncode == 0, done.stdout
