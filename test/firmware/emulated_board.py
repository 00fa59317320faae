"""Starts emulated boards and talks to their control channel.

Needs neither ROS nor the Python package.

with EmulatedBoard(build_firmware(), 'car') as board:
    port = serial.Serial(board.port, 115200)
    board.set('yaw', 30)
    board.wait_until(lambda: board.get('turning') == 0, seconds=5)
"""

import fcntl
import os
import shutil
import socket
import subprocess
import tempfile
import time

HERE = os.path.dirname(os.path.abspath(__file__))
FIRMWARE = os.path.join(os.path.dirname(os.path.dirname(HERE)), 'firmware')

# The program that belongs into each world.
IMAGES = {'car': 'nano_car_emulated.elf', 'ctrl': 'ctrl_board.elf', 'range': 'range_imu.elf',
          'diff': 'DiffDrive.elf'}

# The "old bootloader" of the Nano, 57600 baud, and the folder of all.
BOOTLOADERS = '/usr/share/arduino/hardware/arduino/avr/bootloaders'
BOOTLOADER = os.path.join(BOOTLOADERS, 'atmega', 'ATmegaBOOT_168_atmega328.hex')


class BoardError(Exception):
    """The emulator did not start, ended, or refused a command."""


def build_firmware():
    """Builds the firmware and the emulator, as far as they are not up to date.

    Returns the directory: the one that scripts/avr_board builds into, or FIRMWARE_BUILD.
    """
    build = os.path.abspath(os.environ.get('FIRMWARE_BUILD')
                            or os.path.join(FIRMWARE, os.pardir, 'build', 'firmware'))
    os.makedirs(build, exist_ok=True)
    with open(os.path.join(build, '.lock'), 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # others may build it just now
        result = subprocess.run(
            ['make', '-C', FIRMWARE, 'BUILD=' + os.path.relpath(build, FIRMWARE), '-j2',
             'WARNINGS=-Wall -Wextra -Werror'],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True)
    if result.returncode != 0:
        raise BoardError('the firmware does not build:\n' + result.stdout)
    return build


class EmulatedBoard:
    """One emulator process; a context manager.

    build: the directory that make built into.
    world: car, ctrl, range or diff.
    still: nothing moves but what the board moves and what is set.
    port: an existing tty for the UART; by default the emulator makes a pty, and `port` is its link.
    eeprom: a file to keep the EEPROM in.
    bootloader: a HEX file; each opening of the pty starts it, as of a real Nano.
    """

    def __init__(self, build, world, still=True, port=None, eeprom=None, image=None,
                 bootloader=None):
        self._directory = tempfile.mkdtemp(prefix='avr_board_')
        self._socket = None
        self._pending = b''
        self.port = port or os.path.join(self._directory, 'uart')
        control = os.path.join(self._directory, 'control')
        command = [os.path.join(build, 'avr_emulator'), '--world', world, '--control', control]
        command += ['--port', port] if port else ['--link', self.port]
        command += ['--still'] if still else []
        command += ['--eeprom', eeprom] if eeprom else []
        command += ['--bootloader', bootloader] if bootloader else []
        command.append(os.path.join(build, image or IMAGES[world]))
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                                        universal_newlines=True)
        # The first line comes when everything is set up.
        self.banner = self.process.stdout.readline()
        if 'on' not in self.banner.split():
            self.close()
            raise BoardError('the emulator did not start: ' + self.banner)
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(control)
        self._socket.settimeout(10)

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.close()

    def close(self):
        """Ends the emulator and returns the last line that it printed."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self.process.poll() is None:
            self.process.terminate()
        output = self.process.communicate(timeout=10)[0]
        shutil.rmtree(self._directory, ignore_errors=True)
        return output.strip().split('\n')[-1]

    def ask(self, line):
        """Sends one line to the control channel and returns the answer."""
        self._socket.sendall(line.encode('ascii') + b'\n')
        return self._answer(line)

    def _answer(self, line):
        while b'\n' not in self._pending:
            received = self._socket.recv(4096)
            if not received:
                raise BoardError('the emulator ended')
            self._pending += received
        answer, self._pending = self._pending.split(b'\n', 1)
        answer = answer.decode('ascii')
        if answer.startswith('error'):
            raise BoardError('%s: %s' % (line, answer))
        return answer

    def get(self, name):
        """The value of that name, as a float."""
        return float(self.ask('get ' + name))

    def at_once(self, *names):
        """The values of these names at one moment of the board's."""
        first, *others = ('get ' + name for name in names)
        return [float(self.ask('\n'.join([first, *others])))] + [
            float(self._answer(other)) for other in others]

    def set(self, name, value):
        self.ask('set %s %.10g' % (name, value))

    def history(self, name):
        """The changes of a recorded output, oldest first: a list of (emulated seconds, value)."""
        numbers = [float(word) for word in self.ask('history ' + name).split()]
        return list(zip(numbers[0::2], numbers[1::2]))

    def reset(self):
        self.ask('reset')

    def power_cycle(self):
        self.ask('power_cycle')

    @property
    def time(self):
        """Emulated seconds since the start."""
        return self.get('time')

    def wait_until(self, condition, seconds):
        """Asks for `condition` until it holds; fails after so many emulated seconds."""
        end = self.time + seconds
        while not condition():
            if self.time > end:
                # A computer that was kept from running may have missed it: once more.
                if condition():
                    return
                raise AssertionError('not within %g emulated seconds' % seconds)
            time.sleep(0.001)

    def run_for(self, seconds):
        """Waits for so many emulated seconds."""
        end = self.time + seconds
        self.wait_until(lambda: self.time > end, 2 * seconds + 1)
