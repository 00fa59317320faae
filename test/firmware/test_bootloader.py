"""The emulated Nano with Arduino's own bootloader."""
import os
import signal
import subprocess

import pytest
import serial

from emulated_board import BOOTLOADER, BOOTLOADERS, BoardError, EmulatedBoard

SYNC, IN_SYNC = b'0 ', b'\x14\x10'       # of avrdude, and the bootloader's answer


def synchronised(port):
    """Whether the bootloader answers; each half of an answer may arrive alone."""
    received = b''
    for _ in range(20):
        port.write(SYNC)
        received += port.read(2)
        if IN_SYNC in received:
            return True
    return False


def test_each_opening_starts_the_bootloader_and_then_the_program(firmware_build):
    with EmulatedBoard(firmware_build, 'car', image='Hello.elf', bootloader=BOOTLOADER) as board:
        for _ in range(2):
            with serial.Serial(board.port, 57600, timeout=0.2) as port:
                assert synchronised(port)
                port.baudrate = 115200
                sent = board.get('tx_bytes')
                board.wait_until(lambda sent=sent: board.get('tx_bytes') > sent + 200, 10)
            board.run_for(2.0)
            sent = board.get('tx_bytes')
            board.wait_until(lambda sent=sent: board.get('tx_bytes') > sent, 5)


def test_what_looks_at_an_open_port_does_not_reset_the_board(firmware_build):
    with EmulatedBoard(firmware_build, 'car', image='Hello.elf', bootloader=BOOTLOADER) as board:
        with serial.Serial(board.port, 115200) as port:
            board.wait_until(lambda: board.get('tx_bytes') > 200, 10)
            subprocess.run(['stty', '-F', board.port], check=True, stdout=subprocess.DEVNULL)
            port.write(SYNC)
            for _ in range(5):      # the bootloader would take a second
                sent = board.get('tx_bytes')
                board.run_for(0.2)
                assert board.get('tx_bytes') > sent


def test_a_port_that_two_programs_close_at_once_starts_the_bootloader_when_it_is_opened_again(
        firmware_build):
    with EmulatedBoard(firmware_build, 'car', image='Hello.elf', bootloader=BOOTLOADER) as board:
        with serial.Serial(board.port, 57600):
            board.run_for(0.1)
            with serial.Serial(board.port, 57600):
                board.run_for(0.1)
                board.process.send_signal(signal.SIGSTOP)   # as on a busy machine
        board.process.send_signal(signal.SIGCONT)
        board.run_for(1.5)                              # the bootloader has ended
        with serial.Serial(board.port, 57600, timeout=0.2) as port:
            assert synchronised(port)


@pytest.mark.parametrize('path, words', [
    (os.path.join(BOOTLOADERS, 'optiboot', 'optiboot_atmega328.hex'), 'too long for the flash'),
    ('/dev/null', 'cannot load the bootloader')])
def test_a_bootloader_that_does_not_fit_is_refused(firmware_build, path, words):
    with pytest.raises(BoardError, match=words):
        EmulatedBoard(firmware_build, 'car', bootloader=path)
