"""The emulated Nano with Arduino's own bootloader."""

import serial

from emulated_board import BOOTLOADER, EmulatedBoard

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
