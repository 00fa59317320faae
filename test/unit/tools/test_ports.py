"""The program `ports`, on pseudo terminals with simple boards: what it finds."""
import json
import os
import pty
import random
import subprocess
import sys
import termios
import threading
import tty

import pytest
import yaml

import crane_scale
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.tools.ports import cli
from serial_communication.tools.ports.devices import holders_of
from lines import ROOT
from waiting import until

pytestmark = pytest.mark.slow      # the program listens for seconds
HERE = os.path.dirname(os.path.abspath(__file__))
PROGRAM = os.path.join(ROOT, 'scripts', 'ports')
SYNC = bus.encode_request(bus.SYNC_REQUEST)
MCU = b''.join(mcu.encode(mcu.SensorStatus(40, seq, 1.0, 2.0, 3.0), seq) for seq in range(10))
CAR = b''.join(arduino.encode(each) for each in (arduino.Ticks(3), arduino.SteeringAngle(500)))
SCALE = b''.join(crane_scale.wire.encode(crane_scale.wire.Load(5.0), seq) for seq in range(3))
NOISE = random.Random(1).getrandbits(800).to_bytes(100, 'big')


class Board:
    """The other end of a port: sends `data` all the time, or answers SYNC.

    Args:
        baud: the rate at which it sends; at another one the port receives noise.
    """

    def __init__(self, path, data=b'', baud=115200, answers=False):
        self.path = str(path)
        self.received = b''
        self._data = data
        self._speed = getattr(termios, f'B{baud}')
        self._answers = answers
        self._fd, slave = pty.openpty()
        tty.setraw(slave)
        os.symlink(os.ttyname(slave), self.path)
        os.close(slave)
        os.set_blocking(self._fd, False)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name='board')
        self._thread.start()

    def close(self):
        self._ending.set()
        self._thread.join()
        os.close(self._fd)

    def _run(self):
        while not self._ending.wait(0.01):
            try:
                request = os.read(self._fd, 1000)
            except OSError:     # nothing to read, or nobody has the port open
                request = b''
            self.received += request
            data = self._data
            if self._answers and request == SYNC:
                data = bus.encode_reply(bus.Reply(bus.SYNC))
            if data and termios.tcgetattr(self._fd)[5] != self._speed:
                data = NOISE[:len(data)]
            try:
                os.write(self._fd, data)
            except OSError:     # the port is full
                pass


@pytest.fixture
def board(tmp_path):
    """A function that makes a board on a port, tmp_path/NAME."""
    made = []

    def make(name, *arguments, **options):
        made.append(Board(tmp_path / name, *arguments, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()


def run(*arguments):
    return subprocess.run([sys.executable, PROGRAM, '--seconds', '0.5', *map(str, arguments)],
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding='utf-8',
                          env={**os.environ, 'PYTHONPATH': os.pathsep.join(
                              [HERE, os.environ.get('PYTHONPATH', '')])}, timeout=100)


def found(*arguments):
    """The objects that it prints with --json, by the name of the port."""
    done = run('--json', *arguments)
    assert done.returncode == 0, done.stderr
    return {os.path.basename(each['port']): each for each in json.loads(done.stdout)}


def test_boards_are_found_at_any_usual_rate_and_nothing_is_written(board, tmp_path):
    boards = [board('one', MCU, baud=57600), board('two', CAR), board('three', answers=True),
              board('four', b'boot: ok\r\n')]
    done = run(*(each.path for each in boards), tmp_path / 'absent')
    assert [each.received for each in boards] == [b''] * 4
    assert f'{boards[0].path}  mcu (sensor board), at 57600 baud\n' in done.stdout
    assert f'{boards[2].path}  silent\n' in done.stdout
    assert f'{boards[3].path}  bytes of no known board, at no usual baud rate' in done.stdout
    assert "'boot: ok" in done.stdout and 'there is no such device' in done.stdout
    assert '--ask' in done.stdout and '--config' in done.stdout
    last = done.stdout.partition('\nPut into a configuration (')[2].partition('\n')[2]
    assert yaml.safe_load(last) == {'arduino': {'port': boards[1].path, 'baud': 115200},
                                    'mcu': {'port': boards[0].path, 'baud': 57600}}


def test_only_silent_ports_are_asked_and_only_for_a_sync(board, tmp_path):
    boards = [board('one', MCU), board('two', answers=True), board('three', NOISE), board('four')]
    ports = found('--ask', *(each.path for each in boards), tmp_path / 'absent')
    assert {name: (port['board'], port['heard'], port['baud'], port['held_by'])
            for name, port in ports.items()} == {
        'one': ('mcu', 'frames', 115200, None), 'two': ('bus', 'frames', 115200, None),
        'three': (None, 'noise', None, None), 'four': (None, 'nothing', None, None),
        'absent': (None, 'nothing', None, None)}
    assert ports['one']['port'] == boards[0].path
    assert ports['absent']['trouble'] == 'there is no such device'
    until(lambda: boards[3].received == SYNC * 3, 'the silent board has received all')
    assert [each.received for each in boards] == [b'', SYNC, b'', SYNC * 3]


def test_a_configuration_adds_boards_messages_and_rates(board, tmp_path):
    config = tmp_path / 'base.yaml'
    config.write_text('boards: [crane_scale]\nbus: {baud: 2400}\narduino: {baud: 2400, messages: '
                      '{force: {type: 32, ros_type: a/B, layout: "<h", fields: [data]}}}\n')
    paths = [board('scale', SCALE, baud=9600).path, board('slow', CAR, baud=2400).path,
             board('usual', CAR).path, board('bus', baud=2400, answers=True).path,
             board('own', arduino.encode_raw(32, b'\1\2'), baud=2400).path]
    ports = found('--config', config, '--ask', *paths)
    assert {name: (port['board'], port['baud']) for name, port in ports.items()} == {
        'scale': ('scale', 9600), 'slow': ('arduino', 2400), 'usual': ('arduino', 115200),
        'bus': ('bus', 2400), 'own': ('arduino', 2400)}


_READER = '''
import sys, serial
port = serial.Serial(sys.argv[1], 115200)
while True:
    sys.stdout.buffer.write(port.read(16))
    sys.stdout.flush()
'''


def test_a_port_that_another_program_has_open_is_named_and_not_touched(board, tmp_path):
    """The reader does not lock the port, so it would lose bytes to a second one."""
    port = board('port', MCU)
    script = tmp_path / 'serial_monitor'
    script.write_text(_READER)
    with subprocess.Popen([sys.executable, str(script), port.path],
                          stdout=subprocess.PIPE) as reader:
        try:
            data = reader.stdout.read(16)
            assert holders_of(port.path) == [f'serial_monitor (pid {reader.pid})']
            done = run(port.path)
            assert f'held_by  serial_monitor (pid {reader.pid})' in done.stdout
            assert 'not listened to: another program has it open' in done.stdout
            assert found(port.path)['port']['held_by'] == f'serial_monitor (pid {reader.pid})'
            decoder = mcu.Decoder()
            frames = decoder.feed(data + reader.stdout.read(1600))
            assert len(frames) > 90 and not any(each.cause for each in frames[1:])
        finally:
            reader.kill()
    assert holders_of(port.path) == []


# -- its parts, without a port ------------------------------------------------------------------


@pytest.mark.parametrize('options, words', [([], 'This computer has no serial port.'),
                                            (['--json'], '[]\n')])
def test_a_computer_without_a_serial_port_is_no_error(monkeypatch, capsys, options, words):
    monkeypatch.setattr(cli.devices, 'devices', lambda: [])
    assert cli.main(options) == 0
    assert capsys.readouterr().out.startswith(words)
