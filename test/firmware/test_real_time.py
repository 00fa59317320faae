"""The emulator as people use it: in real time, on a pty. It is only waited for, however long."""
import os
import signal
import struct
import subprocess
from contextlib import contextmanager

import serial
from by_definition import TIME, arduino_at, decode
from waiting import until

from emulated_board import FIRMWARE, Channel

AVR_BOARD = os.path.join(FIRMWARE, os.pardir, 'scripts', 'avr_board')
# The "old bootloader" of the Nano, 57600 baud.
BOOTLOADER = ('/usr/share/arduino/hardware/arduino/avr/bootloaders/atmega/'
              'ATmegaBOOT_168_atmega328.hex')
SYNC, IN_SYNC = b'0 ', b'\x14\x10'       # of avrdude, and the bootloader's answer


@contextmanager
def avr_board(build, folder, *arguments):
    """scripts/avr_board; yields its port and its control channel."""
    port, control = str(folder / 'new' / 'port'), str(folder / 'control')
    with subprocess.Popen([AVR_BOARD, *arguments, '--link', port, '--control', control],
                          stdout=subprocess.PIPE, universal_newlines=True,
                          env=dict(os.environ, FIRMWARE_BUILD=build)) as process:
        try:
            assert 'avr_emulator: ' in process.stdout.readline()
            channel = Channel(control)
            yield port, channel
            channel.close()
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait() == 0 and not os.path.lexists(port)


def board_time(port):
    """Seconds of the board's clock, by the next of its packets that tells it."""
    received = bytearray()

    def told():
        received.extend(port.read(100))
        return [frame.data for frame in decode(bytes(received), arduino_at)[0]
                if frame.type == TIME and len(frame.data) == 5]
    return struct.unpack('<I', until(told)[0][:4])[0] * 1e-6


def test_avr_board_keeps_its_eeprom_and_an_opening_does_not_reset_it(firmware_build, tmp_path):
    eeprom = tmp_path / 'eeprom'
    with avr_board(firmware_build, tmp_path, 'arduino', '--eeprom', str(eeprom)) as (path, board):
        assert len(eeprom.read_bytes()) == 1024
        last = 0.0
        for _ in range(3):
            with serial.Serial(path, 115200, timeout=0.1) as port:
                now = board_time(port)
            assert now > last
            last = now
        until(lambda: board.get('time') > last)


def test_avr_board_runs_any_image(firmware_build, tmp_path):
    image = os.path.join(firmware_build, 'Hello.elf')
    with avr_board(firmware_build, tmp_path, '--elf', image) as (_, board):
        board.set(d4=1)
        until(lambda: board.get('d4') == 1 and board.get('tx_bytes') > 20)


def test_each_opening_starts_the_bootloader_and_then_the_program(firmware_build, tmp_path):
    with avr_board(firmware_build, tmp_path, 'arduino', '--bootloader', BOOTLOADER) as (path, _):
        last = None
        for _ in range(2):
            with serial.Serial(path, 57600, timeout=0.2) as port:
                received = bytearray()

                def in_sync(port=port, received=received):
                    port.write(SYNC)
                    received.extend(port.read(2))
                    return IN_SYNC in received
                until(in_sync)
                port.baudrate = 115200
                now = board_time(port)
                assert last is None or now < last       # it has begun anew
                last = now + 1
                until(lambda port=port, last=last: board_time(port) > last)
