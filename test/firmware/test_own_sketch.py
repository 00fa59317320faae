"""A sketch of one's own: built without the IDE, run in the emulator, with its pins free."""
import os
import signal
import socket
import subprocess

import pytest

from by_definition import arduino_at, decode
from emulated_board import FIRMWARE, EmulatedBoard
from waiting import PATIENCE, until

HERE = os.path.dirname(os.path.abspath(__file__))
AVR_BOARD = os.path.join(FIRMWARE, os.pardir, 'scripts', 'avr_board')


@pytest.fixture(scope='module')
def image(firmware_build):
    # A relative path is the caller's, whatever folder make works in.
    done = make(HERE, 'SKETCH=own', 'BUILD=' + firmware_build)
    assert done.returncode == 0, done.stdout
    image = os.path.join(firmware_build, 'sketches', 'own.elf')
    assert image[:-4] + '.elf' in done.stdout and os.path.exists(image[:-4] + '.hex')
    return image


def make(folder, *arguments):
    return subprocess.run(
        ['make', '-C', FIRMWARE, *arguments], cwd=str(folder), stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, universal_newlines=True, env=dict(os.environ, PWD=str(folder)))


def test_its_pins_are_driven_and_read(firmware_build, image):
    with EmulatedBoard(firmware_build, 'pins', image=image) as board:
        board.wait_until(lambda: board.get('pwm9') == 100, 3)    # the pull-up of pin 6
        for level in 1, 0, 1:
            board.set('d4', level)
            board.wait_until(lambda level=level: board.get('d5') == level, 1)
            assert board.get('d4') == level
        board.set('d6', 0)
        board.wait_until(lambda: board.get('pwm9') == 0, 1)
        board.set('d6', -1)
        board.wait_until(lambda: board.get('pwm9') == 100 and board.get('d6') == 1, 1)
        with open(board.port, 'rb', buffering=0) as port:
            for raw in 512, 7, 0, 511:
                board.set('a0', raw)
                wanted = 0x20, 0, (2 * raw).to_bytes(2, 'little')
                seen = []
                board.wait_until(lambda: seen.append(port.read(64)) or wanted in [
                    frame.content for frame in decode(b''.join(seen), arduino_at)[0]], 2)


def test_avr_board_runs_any_image(image, firmware_build, tmp_path):
    link, control = str(tmp_path / 'folder' / 'port'), str(tmp_path / 'control')
    with subprocess.Popen([AVR_BOARD, '--elf', image, '--link', link, '--control', control],
                          stdout=subprocess.PIPE, universal_newlines=True,
                          env=dict(os.environ, FIRMWARE_BUILD=firmware_build)) as board:
        try:
            assert image in board.stdout.readline()
            with socket.socket(socket.AF_UNIX) as channel:
                channel.connect(control)
                channel.settimeout(PATIENCE)

                def ask(line):
                    channel.sendall(line.encode() + b'\n')
                    return channel.recv(4096).decode().strip()

                assert ask('set d4 1') == 'ok' and ask('set pwm9 3').startswith('error')
                until(lambda: ask('get d5') == '1', 'the chip has read it')
            assert os.path.islink(link)
        finally:
            board.send_signal(signal.SIGTERM)
        assert board.wait(PATIENCE) == 0
