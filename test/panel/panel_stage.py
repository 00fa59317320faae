"""What the tests of the panel share: a master, a robot, a panel, and a page that is a program."""
import base64
import contextlib
import json
import os
import re
import signal
import socket
import struct
import subprocess
import tempfile
import threading
import urllib.error
import urllib.request
from collections import deque

import rosgraph
import rospy
from boards import (AIR, PATIENCE, BusBoard, CarBoard, Bridge, Line, SensorBoard, level_imu,
                    program, ranges, until)

from serial_communication.boards.arduino import wire as arduino

NODE = '/serial_communication'
TOKEN = 'a-token-of-the-tests'


def free_port():
    """A TCP port that nobody uses."""
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


class Core:
    """The roscore at ROS_MASTER_URI."""

    def __init__(self):
        self._process = None
        self.start()

    def start(self):
        """Start it; it answers when this returns."""
        self._process = subprocess.Popen(
            ['roscore', '-p', os.environ['ROS_MASTER_URI'].rsplit(':', 1)[1]],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(rosgraph.is_master_online, 'the master answers', every=0.1)
        until(lambda: '/rosout' in publishers_and_subscribers()[1], 'roscore is complete')

    @contextlib.contextmanager
    def hung(self):
        """It takes connections and answers nothing."""
        pid = rosgraph.Master('/panel_test').getPid()      # roscore only watches this process
        os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(pid, signal.SIGCONT)

    def stop(self):
        """Nothing listens there any more when this returns."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(PATIENCE)


def publishers_and_subscribers():
    """{topic: nodes}, of each kind."""
    try:
        publishers, subscribers, _services = rosgraph.Master('/panel_test').getSystemState()
    except OSError:
        return {}, {}
    return dict(publishers), dict(subscribers)


def subscribed(node):
    """The topics that a node subscribes to; but /clock and the like, which rospy adds."""
    return {topic for topic, nodes in publishers_and_subscribers()[1].items()
            if node in nodes and topic != '/clock'}


class Robot:
    """Lines, boards and a bridge. The boards talk as real ones do, until they are told not to."""

    def __init__(self, folder):
        self.lines = {name: Line(os.path.join(folder, name)).plug()
                      for name in ('bus', 'arduino', 'mcu')}
        self.bus = BusBoard(self.lines['bus'].far, polled=True)
        self.car = CarBoard(self.lines['arduino'].far)
        self.sensors = SensorBoard(self.lines['mcu'].far)
        self.rest()
        self._ended = threading.Event()
        threading.Thread(target=self._talk, daemon=True).start()
        self.start_bridge()

    def rest(self):
        """The boards measure again what they do at first."""
        self.bus.air = AIR
        self.imu = level_imu()
        self.others = [arduino.Voltage(7.4), arduino.Ticks(3), arduino.SteeringAngle(600)]
        self.ranges = ranges()
        self.talks = True

    def start_bridge(self):
        """Start the bridge; its services are there when this returns."""
        self.bridge = Bridge(parameters={
            **{f'{name}/port': line.near for name, line in self.lines.items()},
            'bus/environment_period': 0.2, 'bus/motion_timeout': 1.0,
            # Two whose responses have no status; the first has nothing of an outcome.
            'bus/functions': {
                'beep': {'cmd2': 0x30, 'srv_type': 'std_srvs/Empty', 'timeout': 0.3},
                'dock': {'cmd2': 0x31, 'srv_type': 'std_srvs/Trigger', 'timeout': 0.3}}})
        rospy.wait_for_service(NODE + '/calibrate_imu', PATIENCE)

    def end(self):
        """All of it."""
        self._ended.set()
        self.bridge.end()
        for board in (self.bus, self.car, self.sensors):
            board.close()
        for line in self.lines.values():
            line.unplug()

    def _talk(self):
        while not self._ended.wait(0.02):
            if self.talks:
                self.car.say(self.imu)
                for message in self.others:
                    self.car.say(message)
                self.sensors.say(self.ranges)

    @property
    def lifts(self):
        """The lift's requests that the board has got."""
        return [frame.message for frame in list(self.bus.frames)
                if frame.message.cmd1 == 0x55 and frame.message.cmd2 == 0x20]


class Panel:
    """The program. It prints into a file."""

    def __init__(self, *arguments, port=0, name='panel', environment=None):
        self.node = '/' + name
        self._output = tempfile.TemporaryFile('w+')
        self.process = subprocess.Popen(
            [program('panel'), '--port', str(port), *arguments, '__name:=' + name],
            stdout=self._output, stderr=subprocess.STDOUT,
            env={**os.environ, **(environment or {})})
        self.url = until(lambda: re.search(r'http://\S+', self.output()) or not self.alive,
                         'the panel prints its address').group()
        self.port = int(re.search(r':(\d+)/', self.url).group(1))
        self.token = (re.search(r'token=(.*)', self.url) or [None, None])[1]

    def output(self):
        """What it has printed so far."""
        self._output.seek(0)
        return re.sub('\033\\[[0-9;]*m', '', self._output.read())

    def wait_for(self, words):
        """It prints a line with these words."""
        until(lambda: words in self.output(), f'the panel prints {words!r}')

    @property
    def alive(self):
        """Whether its process runs."""
        return self.process.poll() is None

    def end(self, number=signal.SIGINT):
        """Send a signal; the status it ends with."""
        if self.alive:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE)

    def get(self, path='/', **headers):
        """A request over HTTP, exactly as told: status, headers, text."""
        request = urllib.request.Request(f'http://127.0.0.1:{self.port}{path}', headers={
            name.replace('_', '-'): value for name, value in headers.items()})
        try:
            answer = urllib.request.urlopen(request, timeout=PATIENCE)
        except urllib.error.HTTPError as error:
            answer = error
        with answer:
            return answer.status, answer.headers, answer.read().decode()


class Network:
    """What lies between a browser and a panel: it can be cut, and it can keep all back."""

    def __init__(self, panel):
        self._to = panel.port
        self._pairs = []
        self._flows = threading.Event()
        self._flows.set()
        self._is_cut = False
        self._listener = socket.create_server(('127.0.0.1', 0))
        self.port = self._listener.getsockname()[1]
        self.url = panel.url.replace(f':{panel.port}/', f':{self.port}/')
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self):
        """Every connection ends, and no other is made."""
        self._is_cut = True
        for end in [each for pair in self._pairs for each in pair]:
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass
        self._pairs.clear()

    def mend(self):
        """Connections are made again."""
        self._is_cut = False

    def keep_back(self):
        """Nothing arrives any more, in either way; nothing is lost."""
        self._flows.clear()

    def deliver(self):
        """All that was kept back arrives, at once."""
        self._flows.set()

    def close(self):
        """No more."""
        self._listener.close()
        self.deliver()
        self.cut()

    def _accept(self):
        while True:
            try:
                near, _address = self._listener.accept()
            except OSError:
                return
            if self._is_cut:
                near.close()
                continue
            far = socket.create_connection(('127.0.0.1', self._to))
            self._pairs.append((near, far))
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(source, sink), daemon=True).start()

    def _carry(self, source, sink):
        try:
            while True:
                data = source.recv(65536)
                if not data:
                    break
                self._flows.wait()
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass


class Page:
    """The other end of a panel's WebSocket, with nothing between: it may misbehave."""

    def __init__(self, panel, token=None, watch=(), acknowledges=True, origin='', host='',
                 reads=True):
        host = host or f'127.0.0.1:{panel.port}'
        self.updates = deque(maxlen=5000)
        self.status = None          # of the HTTP answer
        self.closed = ''            # why, once it is
        self.now = 0.0
        self.known = {}             # all that updates have said, the latest of each
        self.rows = {}              # topic -> latest row by field
        self.calls = {}
        self.pongs = 0
        self.holds = 0              # presses of the driving pad
        self.acknowledges = acknowledges
        self._fields = {}
        self._sending = threading.Lock()
        self._socket = socket.socket()
        self._socket.settimeout(PATIENCE)
        if not reads:       # and the system takes little in its stead
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        self._socket.connect(('127.0.0.1', panel.port))
        lines = ['GET /socket HTTP/1.1', f'Host: {host}', 'Upgrade: websocket',
                 'Connection: Upgrade', 'Sec-WebSocket-Version: 13',
                 'Sec-WebSocket-Key: ' + base64.b64encode(os.urandom(16)).decode()]
        if origin is not None:
            lines.append(f'Origin: {origin or "http://" + host}')
        if token:
            lines.append(f'Cookie: panel_{panel.port}={token}')
        self._socket.sendall(('\r\n'.join(lines) + '\r\n\r\n').encode())
        self._stream = self._socket.makefile('rb')
        self.status = int(self._stream.readline().split()[1])
        while self._stream.readline().strip():
            pass
        if self.status == 101:
            self.say(watch=list(watch))
            if reads:
                threading.Thread(target=self._read, daemon=True).start()

    def say(self, **what):
        """Send a message, and what had been seen by then."""
        self.write(json.dumps({'seen': self.now, **what}).encode())

    def write(self, data, kind=0x81):
        """Send these bytes as one message, or as one frame of another kind."""
        mask = os.urandom(4)
        size = struct.pack('>BB', kind, 0x80 | len(data)) if len(data) < 126 \
            else struct.pack('>BBH', kind, 0x80 | 126, len(data))
        masked = bytes(byte ^ mask[index % 4] for index, byte in enumerate(data))
        self.flood(size + mask + masked)

    def flood(self, data):
        """Send these bytes, whatever they are."""
        with self._sending:
            try:
                self._socket.sendall(data)
            except OSError:
                pass        # `closed` tells

    def close(self):
        """Go, without a word."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        self._socket.close()

    def until(self, condition, what):
        """Wait for a condition of this page."""
        return until(lambda: condition(self) or self.closed and 'closed', what)

    def _read(self):
        try:
            while True:
                first, size = self._stream.read(2)
                if size > 125:
                    size = int.from_bytes(self._stream.read(2 if size == 126 else 8), 'big')
                data = self._stream.read(size)
                if first & 15 == 10:
                    self.pongs += 1
                    continue
                if first & 15 == 8:
                    self.closed = data[2:].decode() or 'closed'
                    return
                self._take(json.loads(data))
        except (OSError, ValueError):
            self.closed = self.closed or 'gone'

    def _take(self, update):
        self.now = update['now']
        if self.acknowledges:
            self.say()
        self.known.update(update)
        for name, told in update.get('topics', {}).items():
            if 'fields' in told:
                self._fields[name] = [field[0] for field in told['fields']]
            if told['rows']:
                self.rows[name] = dict(zip(['time', *self._fields[name]], told['rows'][-1]))
        for call in update.get('calls', ()):
            self.calls[call['key']] = call
        self.updates.append(update)
