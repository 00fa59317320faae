"""The list of this computer's serial ports."""
import os
from types import SimpleNamespace

import pytest

from serial_communication.tools.ports import devices
from serial_communication.tools.ports.devices import Device


@pytest.fixture
def computer(tmp_path, monkeypatch):
    """A function that gives this computer ports: (name, the kernel's type of an UART or None)."""
    ttys, links = tmp_path / 'tty', tmp_path / 'serial'
    monkeypatch.setattr(devices, '_TTYS', str(ttys))
    monkeypatch.setattr(devices, '_LINKS', str(links))
    exists = os.path.exists
    there = set()
    monkeypatch.setattr(devices.os.path, 'exists', lambda path: path in there or exists(path))
    usb = []
    monkeypatch.setattr(devices.list_ports, 'comports', lambda: usb)

    def add(name, type_=None, **adapter):
        (ttys / name).mkdir(parents=True)
        if name != 'tty0':      # a console
            (ttys / name / 'device').mkdir()
        if type_ is not None:
            (ttys / name / 'type').write_text(f'{type_}\n')
        path = f'/dev/{name}'
        there.add(path)
        for kind in 'by-id', 'by-path':
            if adapter.get(kind):
                (links / kind).mkdir(parents=True, exist_ok=True)
                (links / kind / adapter[kind]).symlink_to(path)
        if adapter:
            usb.append(SimpleNamespace(device=path, vid=0x1a86, pid=0x7523, manufacturer=None,
                                       product='USB Serial', serial_number=adapter.get('serial')))
        return path

    return SimpleNamespace(add=add, links=links)


def test_ports_are_listed_in_order_and_only_those_with_hardware(computer):
    for name, type_ in (('ttyUSB10', None), ('ttyUSB9', None), ('ttyS0', 4), ('ttyS1', 0),
                        ('tty0', None), ('ttyTHS1', 1)):
        computer.add(name, type_)
    assert [device.path for device in devices.devices()] == [
        '/dev/ttyS0', '/dev/ttyTHS1', '/dev/ttyUSB9', '/dev/ttyUSB10']


def test_a_port_has_all_its_names(computer):
    computer.add('ttyS0', 4)
    computer.add('ttyUSB0', serial='A5005A00', **{'by-id': 'usb-FTDI', 'by-path': 'pci-1'})
    computer.add('ttyUSB1', **{'by-id': 'usb-1a86', 'by-path': 'pci-2'})
    plain, ftdi, clone = devices.devices()
    assert plain == Device('/dev/ttyS0') and plain.name == '/dev/ttyS0'
    links = str(computer.links)
    assert ftdi == Device('/dev/ttyUSB0', f'{links}/by-id/usb-FTDI', f'{links}/by-path/pci-1',
                          'USB Serial 1a86:7523', 'A5005A00')
    assert ftdi.name == ftdi.by_id
    # Two adapters without a serial number have the same name in by-id: the last one has it.
    assert clone.name == f'{links}/by-path/pci-2'


@pytest.mark.parametrize('mode, words', [(0o660, 'usermod -a -G'), (0o600, 'udev')])
def test_a_port_that_this_user_may_not_open_has_its_remedy(tmp_path, monkeypatch, mode, words):
    path = tmp_path / 'port'
    path.touch()
    path.chmod(mode)
    monkeypatch.setattr(devices.grp, 'getgrgid', lambda _: SimpleNamespace(gr_name='dialout'))
    assert devices.no_access(str(path)) == ''
    monkeypatch.setattr(devices.os, 'access', lambda *_given, **_options: False)
    assert words in devices.no_access(str(path))
