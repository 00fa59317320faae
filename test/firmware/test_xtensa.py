"""The protocol headers on an emulated Xtensa processor, as in an ESP32: as on the PC."""
import os
import shutil

import pytest

from compilers import HERE, PROTOCOL, STRICT, STUBS, run

SOURCE = os.path.join(HERE, 'headers_hash.cpp')
QEMU = 'qemu-system-xtensa'
OPTIONS = ['-std=gnu++11', '-Os', *STRICT, '-I', PROTOCOL, SOURCE]


def output(command):
    status, printed = run(command, timeout=60)
    assert status == 0, printed
    return printed.strip()


@pytest.mark.skipif(not shutil.which(QEMU), reason=QEMU + ' is not installed: it is in the package '
                    'qemu-system-misc')
def test_the_headers_behave_as_on_the_pc(tmp_path):
    """There char is unsigned."""
    here, there = str(tmp_path / 'here'), str(tmp_path / 'there')
    output(['g++', '-fsanitize=address,undefined', '-fsigned-char', *OPTIONS, '-o', here])
    output(['xtensa-lx106-elf-g++', '-ffreestanding', '-nostdlib', '-fno-exceptions', '-fno-rtti',
            '-fno-threadsafe-statics', '-mtext-section-literals', '-Wl,-N,--no-warn-rwx-segments',
            '-T', os.path.join(HERE, 'xtensa.ld'), '-I', os.path.join(STUBS, 'no_libc'), *OPTIONS,
            '-o', there])
    expected = output([here])
    assert len(expected) == 8
    assert output([QEMU, '-cpu', 'lx106', '-M', 'sim', '-display', 'none', '-monitor', 'none',
                   '-semihosting', '-kernel', there]) == expected
