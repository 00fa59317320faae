"""What the program `release` asks the master. test/ros/lending_test.py runs it."""
import signal

import pytest
import rosgraph

from serial_communication.link import lending
from serial_communication.tools.release import cli
from serial_communication.tools.watch.calls import Answer, Verdict


@pytest.mark.parametrize('url, host, device', [
    ('/dev/ttyUSB7', '127.0.0.1', '/dev/ttyUSB7'),
    ('/dev/ttyUSB7', '192.0.2.1', None),        # of a network for documentation
    ('socket://localhost:7', '192.0.2.1', 'socket://localhost:7')])
def test_a_device_of_another_machine_is_not_the_one_of_that_name_here(monkeypatch, url, host,
                                                                      device):
    monkeypatch.setattr(rosgraph.Master, 'getParam', lambda _self, _name: url)
    monkeypatch.setattr(rosgraph.Master, 'lookupNode', lambda _self, _name: f'http://{host}:40000/')
    if device:
        assert cli._device('/bridge', 'arduino') == device
        return
    with pytest.raises(ValueError, match=f'is a device of {host}, .*: run this there'):
        cli._device('/bridge', 'arduino')


def test_a_loan_that_is_refused_is_asked_for_again_for_a_while(monkeypatch):
    """The bridge may refuse it because it stalled."""
    lent, refused = Answer(Verdict.DONE, 'lent'), Answer(Verdict.REFUSED, 'not now: lift up 2 mm')
    monkeypatch.setattr(cli, '_AGAIN', 0.0)
    left = [refused, refused, lent, lent]       # the last one gives it back
    monkeypatch.setattr(cli, 'call', lambda *_arguments: left.pop(0))
    loan = cli._Loan('/bridge/arduino/release', 'me')
    assert loan.begin() == ''
    loan.end()
    monkeypatch.setattr(cli, '_AGAIN_FOR', 0.0)
    monkeypatch.setattr(cli, 'call', lambda *_arguments: refused)
    assert cli._Loan('/bridge/arduino/release', 'me').begin() == refused.words


def test_two_releases_of_a_program_with_a_long_name_are_two_borrowers(monkeypatch, tmp_path):
    class Loan:
        def __init__(self, _service, by):
            borrowers.append(by[:lending._LONGEST_NAME])

        begin = end = lambda self: 'not lent: it is a test'

    borrowers, command = [], tmp_path / ('x' * 80)
    command.touch(0o755)
    monkeypatch.setattr(cli, '_Loan', Loan)
    for name in 'prepare_output', '_device', '_Command':
        monkeypatch.setattr(cli, name, lambda *_arguments: '')
    for pid in 4194303, 4194302:        # no pid of Linux is longer
        monkeypatch.setattr(cli.os, 'getpid', lambda pid=pid: pid)
        assert cli.main(['arduino', '--', str(command)]) == 125
    assert len(set(borrowers)) == 2


@pytest.fixture
def handled():
    """The signals that the program `release` handles; their handlers are put back."""
    before = {number: signal.getsignal(number)
              for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield before
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_hangup_does_not_end_a_command_under_nohup(handled):
    """Neither if `release` gets it, nor if the command does."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)        # as nohup does
    command = cli._Command(['sh', '-c', 'kill -HUP $PPID $$; exit 7'])
    assert command.run() == 7
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    assert signal.getsignal(signal.SIGTERM) != handled[signal.SIGTERM]
