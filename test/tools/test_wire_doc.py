"""doc/wire.md: its commands print what the page shows, and its recordings can be made again."""
import os
import re
import subprocess
import sys

import pytest

import wire_recordings
from serial_communication.tools.wire.recording import load
from wire_lines import PATIENCE, ROOT

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
    assert len(BLOCKS) == 7
    for name in wire_recordings.RECORDINGS:
        path = os.path.join(DOC, 'wire', name + '.txt')
        assert os.path.getsize(path) < 20000
        assert any('wire/' + name in command for command, _ in BLOCKS)


@pytest.mark.parametrize('name', wire_recordings.RECORDINGS)
def test_the_recordings_can_be_made_again(name, tmp_path):
    path = tmp_path / (name + '.txt')
    wire_recordings.RECORDINGS[name](str(tmp_path), str(path))
    reads = next(iter(load(str(path)).reads.values()))
    board = b''.join(read.data for read in reads if not read.sent)
    if name == 'baud':
        assert len(board) > 8 and b'\x02\x0c\x10' not in board
    elif name == 'reset':
        assert b'avrboot' in board
        # The bootloader's bytes are in the middle of the silence.
        packets = [read.at for read in reads if not read.sent and b'\0' in read.data]
        assert max(b - a for a, b in zip(packets, packets[1:])) > 0.3
    else:
        moves = [read.at for read in reads if read.sent and b'\x55\x20' in read.data]
        late = [read.at for read in reads if b'\xa5\x00\x02\xa7' in read.data]
        assert len(moves) == 2 and late[0] - moves[0] > 0.5
