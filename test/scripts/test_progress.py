"""How far a program is, on a terminal and elsewhere."""
import io
import threading

import pytest

import progress
from progress import Progress


class Out(io.StringIO):
    def __init__(self, terminal):
        super().__init__()
        self.terminal = terminal

    def isatty(self):
        return self.terminal


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(progress, '_REWRITTEN', 0.005)
    monkeypatch.setattr(progress, '_REPEATED', 0.005)
    monkeypatch.setenv('COLUMNS', '60')


def shown(terminal, total=100.0, text='measuring', notes=3):
    """What stands there after a phase that was looked at so often."""
    out, looks = Out(terminal), []
    starts = [10.0, 10.0]       # asked for as it begins, and for the first line
    told = Progress(out, total, clock=lambda: starts.pop() if starts else 40.0)
    enough = threading.Event()

    def note():
        looks.append(None)
        if len(looks) == notes:
            enough.set()
        return '%d violations so far' % len(looks)

    with told.phase(text, note):
        assert enough.wait(10)
    told.say('done')
    return out.getvalue()


def screen(text):
    """The lines that a terminal shows."""
    return [line.rpartition('\r\033[K')[2] for line in text.split('\n')]


def test_a_line_is_rewritten_on_a_terminal():
    text = shown(True)
    assert screen(text) == ['    0 s  measuring', '   30 s  done', '']
    assert text.count('\n') == 2
    assert '\r\033[K   30 s  measuring, 70 of 100 s left, 2 violations so far\r' in text


def test_lines_stand_below_each_other_elsewhere():
    lines = shown(False).split('\n')
    assert '\r' not in ''.join(lines) and '\033' not in ''.join(lines)
    assert lines[:2] == ['    0 s  measuring',
                         '   30 s  measuring, 70 of 100 s left, 1 violations so far']
    assert lines[-2:] == ['   30 s  done', '']


def test_a_line_is_no_longer_than_the_terminal():
    for line in shown(True, text='m' * 70).split('\r')[1:-1]:
        assert len(line.replace('\033[K', '').split('\n')[0]) <= 59


def test_it_takes_longer_than_was_thought():
    assert 'measuring, soon done, 1 violations' in shown(False, total=20.0)


def test_how_long_it_takes_is_not_known():
    assert 'measuring, 1 violations' in shown(False, total=0.0)
