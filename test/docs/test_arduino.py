"""What firmware/README.md says about Arduino's tools and wiring: the names of boards, against the
core's own list and with Arduino's own builder, and the pins in its tables and drawings."""
import re
import shutil
import subprocess

import pytest
from pages import ROOT

PAGE = (ROOT / 'firmware' / 'README.md').read_text()
HARDWARE = '/usr/share/arduino/hardware'
BOARDS = f'{HARDWARE}/arduino/avr/boards.txt'
BOOTLOADERS = re.findall(
    r'^\| .*?(\d+) baud.*?`(arduino:avr:nano:cpu=(\w+))`.*\| `FLASH_BAUD=(\d+)`',
    PAGE, re.MULTILINE)


def boards():
    """The core's list of boards: keys and values."""
    with open(BOARDS, encoding='utf-8') as file:
        return dict(re.findall(r'^([^#=\n]+)=(.*)$', file.read(), re.MULTILINE))


def test_the_boards_and_bootloaders_of_the_page_are_in_the_core():
    known = boards()
    assert len(BOOTLOADERS) == 2
    for baud, _, processor, flash_baud in BOOTLOADERS:
        assert known[f'nano.menu.cpu.{processor}.upload.speed'] == baud == flash_baud
    for board in set(re.findall(r'arduino:avr:(\w+)', PAGE)):
        assert f'{board}.name' in known


@pytest.mark.skipif(not shutil.which('arduino-builder'), reason='arduino-builder is not installed')
@pytest.mark.parametrize('fqbn', [fqbn for _, fqbn, _, _ in BOOTLOADERS])
def test_arduinos_own_builder_finds_the_library_and_compiles_the_example(fqbn, tmp_path):
    libraries = tmp_path / 'libraries'
    libraries.mkdir()
    (libraries / 'SerialCommunicationProtocol').symlink_to(ROOT / 'firmware' / 'protocol')
    (tmp_path / 'build').mkdir()
    done = subprocess.run(
        ['arduino-builder', '-compile', '-hardware', HARDWARE,
         '-hardware', '/usr/share/arduino-builder', '-tools', HARDWARE,
         '-libraries', str(libraries), '-build-path', str(tmp_path / 'build'),
         '-fqbn', fqbn, '-warnings', 'none', '-prefs=runtime.tools.avr-gcc.path=/usr',
         '-prefs=tools.ctags.path=/usr/bin', '-prefs=tools.ctags.cmd.path=/usr/bin/arduino-ctags',
         # The core's String wants a macro that the float.h of Debian's avr-gcc hides from C++.
         '-prefs=compiler.cpp.extra_flags=-DDECIMAL_DIG=__DECIMAL_DIG__',
         str(libraries / 'SerialCommunicationProtocol/examples/Hello/Hello.ino')],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert done.returncode == 0 and 'Sketch uses ' in done.stdout, done.stdout


def pins_of(table):
    """The pins in the first column of a table: D2, A4."""
    return {pin for row in re.findall(r'^\| (.*?) \|', table, re.MULTILINE)
            for pin in re.findall(r'\b[AD]\d+\b|GPIO \d+', row)}


@pytest.mark.parametrize('board', ('nano_car', 'ctrl_board', 'range_imu'))
def test_table_drawing_and_firmware_have_the_same_pins(board):
    section = re.search(rf'^### {board}\n(.*?)(?=^###)', PAGE, re.MULTILINE | re.DOTALL).group(1)
    drawing = (ROOT / 'doc' / 'wiring' / f'{board}.svg').read_text()
    drawn = set(re.findall(r'>([AD]\d+|GPIO \d+)<', drawing))
    assert drawn == pins_of(section)
    header = ROOT / 'firmware' / board / 'board.h'
    if header.exists():
        named = re.findall(r'^const uint8_t k\w+Pin = (A?\d+);', header.read_text(), re.MULTILINE)
        assert {pin if pin[0] == 'A' else f'D{pin}' for pin in named} == drawn - {'A4', 'A5'}
