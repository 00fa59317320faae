"""What the tests of the panel share: a master, a robot, a panel, and a page without a browser."""
import base64
import contextlib
import json
import os
import re
import signal
import socket
import struct
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from urllib.parse import urlsplit

import rosgraph
import rospy
from boards import (AIR, PATIENCE, BusBoard, CarBoard, Bridge, Line, Output, SensorBoard,
                    again_if_stalled, free_master, level_imu, program, ranges, until)

from serial_communication.boards.arduino import wire as arduino

NODE = '/serial_communication'
TOKEN = 'a-token-of-the-tests'
# Why nothing was sent, if a stall of this machine kept the command back. It may be repeated.
KEPT_BACK = re.compile('press again|call again|one call at a time|while the bridge stalled|'
                       'no connection to the panel|(bridge|ROS master) does not answer|'
                       '; nothing was sent|the board is silent|the port takes no data|'
                       'the line has not sent')


def free_port():
    """Like that of a master: no outgoing connection gets it while nobody listens on it."""
    return urlsplit(free_master()).port


class Core:
    """The roscore at ROS_MASTER_URI."""

    def __init__(self):
        self._process = None
        self.start()

    def start(self):
        """Start it, and wait until it answers."""
        self._process = subprocess.Popen(
            ['roscore', '-p', os.environ['ROS_MASTER_URI'].rsplit(':', 1)[1]],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(rosgraph.is_master_online, 'the master answers', 60, every=0.1)
        until(lambda: '/rosout' in publishers_and_subscribers()[1], 'roscore is complete')

    def stop(self):
        """Stop it, and wait until it has ended."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(PATIENCE)


def publishers_and_subscribers():
    """{topic: nodes that publish it}, {topic: nodes that subscribe to it}."""
    try:
        publishers, subscribers, _services = rosgraph.Master('/panel_test').getSystemState()
    except OSError:
        return {}, {}
    return dict(publishers), dict(subscribers)


def subscribed(node):
    """The topics that a node subscribes to, except /clock, which rospy adds."""
    return {topic for topic, nodes in publishers_and_subscribers()[1].items()
            if node in nodes and topic != '/clock'}


class Robot:
    """Lines, boards and a bridge. The boards send as real ones do, while `sends` is true."""

    def __init__(self, folder):
        self.lines = {name: Line(os.path.join(folder, name)).plug()
                      for name in ('bus', 'arduino', 'mcu')}
        self.bus = BusBoard(self.lines['bus'].far)
        self.car = CarBoard(self.lines['arduino'].far)
        self.sensors = SensorBoard(self.lines['mcu'].far)
        self.reset()
        self._ended = threading.Event()
        threading.Thread(target=self._send, daemon=True).start()
        self.start_bridge()

    def reset(self):
        """The boards send the initial values again."""
        self.bus.air = AIR
        self.imu = level_imu()
        self.others = [arduino.Voltage(7.4), arduino.Ticks(3), arduino.SteeringAngle(600)]
        self.ranges = ranges()
        self.sends = True

    def start_bridge(self):
        """Start the bridge, and wait for its services."""
        self.bridge = Bridge(parameters={
            **{f'{name}/port': line.near for name, line in self.lines.items()},
            'bus/environment_period': 0.2, 'bus/motion_timeout': 1.0,
            'arduino/settings': {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10,
                                        'unit': '1/s', 'description': 'proportional gain'}},
            'arduino/messages': {'gripper': {
                'type': 40, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Vector3',
                'layout': '<hhB', 'fields': ['x', 'y', 'z'], 'scale': [0.1, 0.1, 1],
                'minimum': [-10, 0, 0], 'maximum': [10, 50, 3]}, 'cmd_vel': {
                'type': 41, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist',
                'layout': '<ff', 'fields': ['linear.x', 'angular.z']}},
            # The responses of both have no status; the first also has no field for success.
            'bus/functions': {
                'weigh': {'cmd2': 0x32, 'srv_type': 'serial_communication/GetEnvironment',
                          'reply': {'layout': '<Hf', 'fields': ['environment.smoke',
                                                                'environment.temperature']}},
                'beep': {'cmd2': 0x30, 'srv_type': 'std_srvs/Empty', 'timeout': 0.3},
                'dock': {'cmd2': 0x31, 'srv_type': 'std_srvs/Trigger', 'timeout': 0.3}}})
        rospy.wait_for_service(NODE + '/calibrate_imu', PATIENCE)

    def end(self):
        """End the bridge, the boards and the lines."""
        self._ended.set()
        self.bridge.end()
        for board in (self.bus, self.car, self.sensors):
            board.close()
        for line in self.lines.values():
            line.unplug()

    def _send(self):
        while not self._ended.wait(0.02):
            if self.sends:
                self.car.say(self.imu)
                for message in self.others:
                    self.car.say(message)
                self.sensors.say(self.ranges)

    @property
    def lift_requests(self):
        """The requests for the lift that the board has received."""
        return [frame.message for frame in list(self.bus.frames)
                if frame.message.cmd1 == 0x55 and frame.message.cmd2 == 0x20]


class Panel:
    """A panel in a process of its own, whose output goes to a file; None: its default.

    As a context it ends with its block, and has to end well.
    """

    def __init__(self, *arguments, port=0, name='panel', environment=None):
        self.node = f'/{name}'
        self._output = Output()
        self.process = subprocess.Popen(
            [program('panel'), *([] if port is None else ['--port', str(port)]), *arguments,
             *([] if name is None else ['__name:=' + name])],
            stdout=self._output, stderr=subprocess.STDOUT,
            env={**os.environ, **(environment or {})})

        def address():
            has_ended = not self.alive      # before it is read: it may print it and end meanwhile
            return re.search(r'http://\S+', self.output()) or has_ended
        self.url = until(address, 'the panel prints its address').group()
        self.port = int(re.search(r':(\d+)/', self.url).group(1))
        self.token = self.url.partition('#')[2]

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        status = self.end()
        assert kind or status == 0 and 'Traceback' not in self.output(), self.output()

    def output(self):
        """The output so far."""
        return re.sub('\033\\[[0-9;]*m', '', self._output.text())

    def wait_for(self, words):
        """Wait until it has printed this text."""
        until(lambda: words in self.output(), f'the panel prints {words!r}')

    @property
    def alive(self):
        return self.process.poll() is None

    def end(self, number=signal.SIGINT):
        """Send a signal; return the exit status."""
        if self.alive:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE)

    def get(self, path='/', **headers):
        """Send an HTTP request with exactly these headers; return status, headers and text."""
        return request(self.port, path, None, headers)

    def exchange(self, token, **headers):
        """Send a token to be exchanged for a key; return status, headers and text."""
        return post(self.port, '/key', token.encode(), headers)


def post(port, path, body, headers=None):
    """Send a POST request with the Origin of the page itself; return as `request`."""
    return request(port, path, body, {'Origin': f'http://127.0.0.1:{port}', **(headers or {})})


def request(port, path, body, headers):
    """Send an HTTP request, a POST if it has a body; return status, headers and text."""
    wanted = urllib.request.Request(
        f'http://127.0.0.1:{port}{path}', body,
        {name.replace('_', '-'): value for name, value in headers.items()})
    try:
        answer = urllib.request.urlopen(wanted, timeout=PATIENCE)
    except urllib.error.HTTPError as error:
        answer = error
    with answer:
        return answer.status, answer.headers, answer.read().decode()


class Network:
    """A network between a browser and a panel that can be cut: socat."""

    def __init__(self, panel):
        self.port = free_port()
        self.url = panel.url.replace(f':{panel.port}/', f':{self.port}/')
        self._command = ['socat', f'TCP-LISTEN:{self.port},bind=127.0.0.1,fork,reuseaddr',
                         f'TCP:127.0.0.1:{panel.port}']
        self._begin()

    def end(self):
        """Close every connection, and accept no other."""
        self._send(signal.SIGKILL)
        self._process.wait()

    @contextlib.contextmanager
    def cut(self):
        """Inside this block, there is no connection."""
        self.end()
        try:
            yield
        finally:
            self._begin()

    def _begin(self):
        self._process = subprocess.Popen(self._command, start_new_session=True)
        until(self._answers, 'the network is there')

    def _answers(self):
        with socket.socket() as probe:
            return probe.connect_ex(('127.0.0.1', self.port)) == 0

    def _send(self, number):
        """Send a signal to socat, and to its process for each connection."""
        os.killpg(self._process.pid, number)


class Page:
    """A client of a panel's WebSocket, which may also misbehave.

    Args:
        patient: if too many pages are open, wait: those of the test before may still be counted.
    """

    def __init__(self, panel, token=None, watch=(), origin='', host='',
                 patient=True):
        self.updates = deque(maxlen=5000)
        self.status = None          # of the HTTP answer
        self.closed = ''            # the reason, once it is closed
        self.now = 0.0
        self.known = {}             # the latest value of each key of the updates
        self.samples = {}           # topic -> latest sample by field
        self.calls = {}
        self.holds = 0              # presses of the driving pad
        self._fields = {}
        self._sending = threading.Lock()
        host = host or f'127.0.0.1:{panel.port}'
        lines = ['GET /socket HTTP/1.1', f'Host: {host}', 'Upgrade: websocket',
                 'Connection: Upgrade', 'Sec-WebSocket-Version: 13',
                 'Sec-WebSocket-Key: ' + base64.b64encode(os.urandom(16)).decode()]
        if origin is not None:
            lines.append(f'Origin: {origin or "http://" + host}')
        if token:
            status, _headers, key = panel.exchange(token)
            lines.append(f'Sec-WebSocket-Protocol: panel, {key if status == 200 else token}')
        header = ('\r\n'.join(lines) + '\r\n\r\n').encode()
        until(lambda: self._connect(panel.port, header) != 503 or not patient,
              'there is room for another page', every=0.1)
        if self.status == 101:
            self.send(watch=list(watch))
            threading.Thread(target=self._read, daemon=True).start()

    def _connect(self, port, header):
        self._socket = socket.socket()
        self._socket.settimeout(PATIENCE)
        self._socket.connect(('127.0.0.1', port))
        self._socket.sendall(header)
        self._stream = self._socket.makefile('rb')
        self.status = int(self._stream.readline().split()[1])
        while self._stream.readline().strip():
            pass
        return self.status

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    @property
    def refusals(self):
        """Why commands were refused, by key."""
        return {update['refused']['key']: update['refused']['words']
                for update in list(self.updates) if 'refused' in update}

    def send(self, **message):
        """Send a message with the time of the latest update."""
        self.write(json.dumps({'seen': self.now, **message}).encode())

    def call(self, name, **arguments):
        """Call a service until it is answered; return the answer."""
        self.until(lambda page: name in page.known.get('controls', {}).get('services', ()), name)

        def answer():
            key = f'{name} at {time.monotonic()}'        # a page also receives earlier calls
            self.send(call={'key': key, 'name': name, 'arguments': arguments})
            return self.answer(key)
        return again_if_stalled(answer)

    def answer(self, key):
        """Wait for the answer to a call and return it; None if a stall of this machine kept the
        call back, and it may be repeated."""
        self.until(lambda page: key in page.refusals or page.calls.get(key, {}).get('outcome'),
                   'the answer')
        words = self.refusals.get(key) or self.calls[key]['words']
        if KEPT_BACK.search(words):
            time.sleep(0.6)       # or the next one may be a double click
            return None
        assert key in self.calls, words
        return self.calls[key]

    def write(self, data, kind=0x81):
        """Send these bytes as one message, or as one WebSocket frame of another kind."""
        mask = os.urandom(4)
        size = struct.pack('>BB', kind, 0x80 | len(data)) if len(data) < 126 \
            else struct.pack('>BBH', kind, 0x80 | 126, len(data))
        masked = bytes(byte ^ mask[index % 4] for index, byte in enumerate(data))
        self.send_raw(size + mask + masked)

    def send_raw(self, data):
        with self._sending:
            try:
                self._socket.sendall(data)
            except OSError:
                pass        # see `closed`

    def close(self):
        """Close the connection without a close frame."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        self._socket.close()

    def until(self, condition, what):
        """Wait for a condition of this page."""
        return until(lambda: condition(self) or self.closed and 'closed', what)

    def settle(self):
        """Wait until commands are taken: not in the first second."""
        self.until(lambda page: 'node' in page.known and page.updates, 'the panel sends updates')
        first = self.updates[0]['now']
        self.until(lambda page: page.now > first + 1, 'a second passes')
        return self

    def _read(self):
        try:
            while True:
                first, size = self._stream.read(2)
                if size > 125:
                    size = int.from_bytes(self._stream.read(2 if size == 126 else 8), 'big')
                data = self._stream.read(size)
                if first & 15 == 8:
                    self.closed = data[2:].decode() or 'closed'
                    return
                self._take(json.loads(data))
        except (OSError, ValueError):
            self.closed = self.closed or 'gone'

    def _take(self, update):
        self.now = update['now']
        self.send()
        self.known.update(update)
        for name, changes in update.get('topics', {}).items():
            if 'fields' in changes:
                self._fields[name] = [field[0] for field in changes['fields']]
            if changes['samples']:
                self.samples[name] = dict(zip(['time', *self._fields[name]],
                                              changes['samples'][-1]))
        for call in update.get('calls', ()):
            self.calls[call['key']] = call
        self.updates.append(update)
