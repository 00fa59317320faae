"""What the program `release` asks the master. test/ros/lending_test.py runs it."""
import pytest
import rosgraph

from serial_communication.tools.release import cli


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
