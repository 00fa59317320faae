"""doc/wire.md: its commands print what the page shows, of the recordings in doc/wire."""
import os
import re
import subprocess
import sys

import pytest

from waiting import PATIENCE
from wire_lines import ROOT

DOC = os.path.join(ROOT, 'doc')
with open(os.path.join(DOC, 'wire.md'), encoding='utf-8') as page:
    BLOCKS = re.findall(r'^    \$ (wire .*)\n((?:    .*\n|\n(?=    ))*)', page.read(),
                        re.MULTILINE)


@pytest.mark.parametrize('command, shown', BLOCKS, ids=lambda text: text.split('\n')[0][:40])
def test_a_command_prints_what_the_page_shows(command, shown):
    done = subprocess.run([sys.executable, os.path.join(ROOT, 'scripts', 'wire')]
                          + command.split()[1:], cwd=DOC, timeout=PATIENCE, text=True,
                          stdout=subprocess.PIPE, env=dict(os.environ, TZ='UTC'))
    output = iter(line.rstrip() for line in done.stdout.splitlines())
    for line in shown.splitlines():
        line = line[4:].rstrip()
        if line != '…':
            assert line in output, line       # and in this order


def test_the_page_uses_every_recording():
    names = [name for name in os.listdir(os.path.join(DOC, 'wire'))
             if any('wire/' + name in command for command, _ in BLOCKS)]
    assert len(BLOCKS) == 7 and sorted(names) == sorted(os.listdir(os.path.join(DOC, 'wire')))
