"""Emulated boards in lock step with a test; needs neither ROS nor the package.

A board's time moves only in run(), so nothing depends on how busy this machine is:

    board = Booted(build_firmware(), 'car').copy()
    board.beat = arduino_packet(HEARTBEAT)      # what the computer sends every 10 ms
    board.run(0.5)
    board.next(TICKS, 10)
"""
import fcntl
import os
import shutil
import socket
import subprocess
import tempfile
from typing import NamedTuple

from by_definition import arduino_at, decode, mcu_at, reply_at

HERE = os.path.dirname(os.path.abspath(__file__))
FIRMWARE = os.path.join(os.path.dirname(os.path.dirname(HERE)), 'firmware')

# The program that belongs into each world.
IMAGES = {'car': 'nano_car_emulated.elf', 'ctrl': 'ctrl_board.elf', 'range': 'range_imu.elf',
          'diff': 'DiffDrive.elf'}
# The protocol of what is sent there.
PROTOCOLS = {'ctrl': reply_at, 'range': mcu_at}

BEAT = 0.01     # s
TEXTS = range(4)


class BoardError(Exception):
    """The emulator did not start, ended, or refused a command."""


class Received(NamedTuple):
    """A frame or packet from a board, and the emulated second in which its last bit was sent."""

    at: float
    type: int
    number: int
    data: bytes


def build_firmware():
    """Build the firmware and the emulator, as far as they are not up to date.

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


class Emulator:
    """A process of the emulator, with a folder of its own for its sockets and links."""

    def __init__(self, build, world, image, *options):
        self.folder = tempfile.mkdtemp(prefix='avr_board_')
        self.control = os.path.join(self.folder, 'control')
        self.port = os.path.join(self.folder, 'uart')       # in real time
        self._process = subprocess.Popen(
            [os.path.join(build, 'avr_emulator'), '--world', world, '--control', self.control,
             '--link', self.port, *options, os.path.join(build, image or IMAGES[world])],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True)
        banner = self._process.stdout.readline()    # comes when everything is set up
        if 'on' not in banner.split():
            self.close()
            raise BoardError('the emulator did not start: ' + banner)

    def close(self):
        """End it; copies go on."""
        self._process.terminate()
        self._process.wait()
        self._process.stdout.close()
        shutil.rmtree(self.folder, ignore_errors=True)


class Channel:
    """A client of the emulator's control channel."""

    def __init__(self, path):
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(path)
        self._answers = self._socket.makefile('r', encoding='ascii')

    def close(self):
        """End it; in lock step, so does the board."""
        self._answers.close()
        self._socket.close()

    def ask(self, line):
        """Send one line, and return the answer."""
        self._socket.sendall(line.encode('ascii') + b'\n')
        answer = self._answers.readline().rstrip('\n')
        if not answer or answer.startswith('error'):
            raise BoardError(f'{line}: {answer or "the emulator ended"}')
        return answer

    def get(self, name):
        """Return the value of that name, as a float."""
        return float(self.ask('get ' + name))

    def set(self, **values):
        """Set these values."""
        for name, value in values.items():
            self.ask(f'set {name} {float(value):.10g}')

    def history(self, name):
        """Return the changes of an output, oldest first: a list of (emulated s, value)."""
        numbers = [float(word) for word in self.ask('history ' + name).split()]
        return list(zip(numbers[0::2], numbers[1::2]))


class Booted(Emulator):
    """A board that has run for `boot` emulated seconds, and stands; each copy begins there."""

    def __init__(self, build, world, image=None, boot=0.1):
        super().__init__(build, world, image, '--lock-step', '--still', '--boot', str(boot))
        self._frame_at = PROTOCOLS.get(world, arduino_at)

    def copy(self):
        """Return a board of its own."""
        return Board(self.control, self._frame_at)


class Board(Channel):
    """A board in lock step, and the computer's end of its link.

    `beat` is sent every 10 ms while the board runs. `received` has what has come since forget().
    """

    def __init__(self, path, frame_at):
        super().__init__(path)
        self.beat = b''
        self.received = []
        self._frame_at = frame_at
        self._rest = bytearray()    # the beginning of a frame
        self._times = []            # when each of its bytes was sent
        self._next_beat = 0.0
        self.now = self.get('time')

    def send(self, data):
        """Put bytes on the line to the board, behind those that are there."""
        for at in range(0, len(data), 1000):
            self.ask('send ' + data[at:at + 1000].hex())

    def run(self, seconds):
        """Let the board run for so many emulated seconds."""
        end = self.now + seconds
        while self.beat:
            self._next_beat = max(self._next_beat, self.now)
            if self._next_beat >= end:
                break
            self._run_until(self._next_beat)
            self.send(self.beat)
            self._next_beat += BEAT
        self._run_until(end)

    def _run_until(self, end):
        now, *sent = self.ask(f'run {end:.7f}').split()
        self.now = float(now)
        if not sent:
            return
        for each in sent:
            at, byte = each.split(':')
            self._times.append(float(at))
            self._rest += bytes.fromhex(byte)
        frames, used = decode(bytes(self._rest), self._frame_at)
        self.received += [Received(self._times[frame.end - 1], *frame.content) for frame in frames]
        del self._rest[:used], self._times[:used]

    def until(self, condition, most=5.0):
        """Run until a condition holds; it has to within `most` emulated seconds."""
        end = self.now + most
        while not condition():
            assert self.now < end, f'not within {most:g} emulated seconds'
            self.run(0.001)

    def forget(self):
        """Drop what has been received."""
        self.received = []

    def seen(self, kind):
        """Return the data of all of a kind."""
        return [frame.data for frame in self.received if frame.type == kind]

    def next(self, kind, count=1, most=5.0):
        """Return the data of the next so many of a kind."""
        self.forget()
        self.until(lambda: len(self.seen(kind)) >= count, most)
        return self.seen(kind)

    def texts(self):
        """Return the texts of a car for the log."""
        return [frame.data.rstrip(b'\0').decode('ascii', 'replace')
                for frame in self.received if frame.type in TEXTS]

    def says(self, text, most=5.0):
        """Run until the board has said something with this text."""
        self.until(lambda: any(text in each for each in self.texts()), most)

    def reply(self, most=1.0):
        """Return the next reply of a bus board: CMD1 and DATE."""
        self.until(lambda: self.received, most)
        reply = self.received.pop(0)
        return bytes((reply.type,)) + reply.data

    def call(self, request, most=5.0):
        """Send a request on the bus; return its reply."""
        self.send(request)
        return self.reply(most)
