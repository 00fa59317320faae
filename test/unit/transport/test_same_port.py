"""Two names of one port have one identity."""
import os

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from serial_communication.transport.urls import identity


def test_all_paths_and_links_of_a_device_are_the_same_port(line, tmp_path):
    device = os.path.realpath(line.path)
    (tmp_path / 'by-id').symlink_to(device)
    (tmp_path / 'link').symlink_to(tmp_path / 'by-id')
    folder, name = os.path.split(device)
    for url in (device, f'{folder}/../{os.path.basename(folder)}/{name}', f'{folder}//{name}',
                str(tmp_path / 'by-id'), str(tmp_path / 'link'), os.path.relpath(device),
                f'spy://{device}?file=/dev/null', f'SPY://{device}',
                f'alt://{device}?class=PosixPollSerial'):
        assert identity(url) == identity(device), url
    assert identity('/dev/null') != identity('/dev/zero'), 'of one driver'


def test_a_pattern_of_devices_and_the_device_that_it_finds_are_the_same_port(monkeypatch):
    monkeypatch.setattr(list_ports, 'comports', lambda *_: [ListPortInfo('/dev/null')])
    assert identity('hwgrep://nul+') == identity('HWGREP://null') == identity('/dev/null')


def test_an_absent_device_is_identified_by_its_path(tmp_path):
    absent = str(tmp_path / 'absent')
    (tmp_path / 'link').symlink_to(absent)
    assert identity(absent) == identity(f'{tmp_path}/./absent') == identity(str(tmp_path / 'link'))
    assert identity(absent) != identity(absent + '1')


@pytest.mark.parametrize('one, other, same', [
    ('socket://robot:4001', 'SOCKET://Robot:4001', True),
    ('socket://robot:4001', 'rfc2217://robot:4001?logging=debug', True),
    ('socket://localhost:4001', 'socket://127.0.0.1:4001', True),
    ('socket://[::1]:4001', 'socket://[::1]:4001', True),
    ('socket://robot:4001', 'socket://robot:4002', False),
    ('socket://robot:4001', 'socket://robot2:4001', False),
    ('hwgrep://0403:6001', 'HWGREP://0403:6001', True),
    ('hwgrep://0403:6001', 'hwgrep://0403:6001&n=2', False)])
def test_urls_of_one_port_are_the_same_port(one, other, same):
    assert (identity(one) == identity(other)) is same


@pytest.mark.parametrize('url', ['loop://', 'LOOP://', 'hwgrep://0403:6001&skip_busy'])
def test_a_url_with_a_different_port_at_each_opening_has_no_identity(url):
    assert identity(url) is None


@pytest.mark.parametrize('url', ['', 'nosuch://x', '\0', 'socket'])
def test_a_url_that_cannot_be_opened_has_an_identity(url):
    assert identity(url) == identity(url)
