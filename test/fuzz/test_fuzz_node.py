"""Any bytes into the three ports of a running node: it keeps running and receives valid frames."""
import os
import time
from collections import deque
from functools import partial

import pytest
import waiting
from fake_boards import BusBoard, CarBoard, SensorBoard
from fuzz_streams import garbage
from hypothesis import given
from lines import Pty

rospy = pytest.importorskip('rospy')
from serial_communication.msg import McuStatus2, SerialMsg, Ticks  # noqa: E402
from serial_communication.boards.arduino import wire as arduino  # noqa: E402
from serial_communication.boards.mcu import wire as mcu  # noqa: E402
from serial_communication.boards.bus import wire as bus  # noqa: E402
from serial_communication.srv import BusRequest  # noqa: E402
from processes import Stage, usage_of  # noqa: E402

NODE = '/serial_communication'
PATIENCE = 10.0          # s; only a test that fails waits as long
_GIVEN_UP = 0.08         # s after which the node has dropped an incomplete frame
_GROWTH = 8.0            # MB by which the node's memory may grow

_number = [0]            # of the example
until = partial(waiting.until, seconds=PATIENCE, every=0.02)


def returned(request):
    """What the bus board answers: every function returns the data that it gets."""
    return bus.Reply(bus.OK, request.data) if request.cmd1 == bus.FUNCTION else None


class Scene:
    """The node, its three ports, and what it publishes."""

    def __init__(self, folder):
        self.stage = Stage('', folder).__enter__()
        lines = {name: Pty(f'{folder}/{name}').plug() for name in ('bus', 'arduino', 'mcu')}
        self.ports = {'bus': BusBoard(lines['bus'], rule=returned),
                      'arduino': CarBoard(lines['arduino']), 'mcu': SensorBoard(lines['mcu'])}
        self.bridge = self.stage.bridge({name: line.path for name, line in lines.items()},
                                        {'bus/reply_timeout': 0.2, 'bus/environment_period': 0.0})
        rospy.init_node('fuzz', anonymous=True, disable_signals=True, disable_rosout=True)
        self.seen = {'ticks': deque(maxlen=50), 'ranges': deque(maxlen=50)}
        self.seq = 0
        rospy.Subscriber(NODE + '/ticks', Ticks, lambda m: self.seen['ticks'].append(m.value))
        rospy.Subscriber('/mcu/status', McuStatus2, lambda m: self.seen['ranges'].append(
            m.vl53_1))
        rospy.Subscriber('/serial_msg', SerialMsg, lambda m: None)
        rospy.wait_for_service(NODE + '/bus/request', PATIENCE)
        self.request = rospy.ServiceProxy(NODE + '/bus/request', BusRequest)
        self.check_valid_frames()
        self.memory = usage_of(self.bridge.pid)['memory']

    def check_valid_frames(self):
        """Each board's next valid frame is received, with the values that the board sent."""
        _number[0] += 1
        number = _number[0]
        ticks, status = number % 250 + 1, mcu.SensorStatus(number % 2000 + 30, 500, 1.0, 2.0, 3.0)
        for values in self.seen.values():
            values.clear()

        def talk():
            if ticks not in self.seen['ticks']:
                self.ports['arduino'].write(b'\0' + arduino.encode(arduino.Ticks(ticks)))
            if status.range_1 not in self.seen['ranges']:
                self.seq = (self.seq + 1) % 256
                self.ports['mcu'].write(mcu.encode(status, self.seq))

        until(lambda: ticks in self.seen['ticks'] and status.range_1 in self.seen['ranges'],
              'data of both boards', doing=talk, every=0.05)
        data = number.to_bytes(8, 'little')
        until(lambda: bytes(self.request(bus.FUNCTION, 0xF0, data).data) == data,
              'a request is answered')

    def close(self):
        self.stage.__exit__()
        for board in self.ports.values():
            board.close()
            board.line.unplug()


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    before = dict(os.environ)
    one = Scene(str(tmp_path_factory.mktemp('fuzz')))
    yield one
    one.close()
    os.environ.clear()
    os.environ.update(before)


@given(for_bus=garbage, for_arduino=garbage, for_mcu=garbage)
def test_the_node_keeps_running_and_receives_valid_frames(scene, for_bus, for_arduino, for_mcu):
    scene.ports['bus'].write(for_bus)
    scene.ports['arduino'].write(for_arduino)
    scene.ports['mcu'].write(for_mcu)
    time.sleep(_GIVEN_UP)
    assert scene.bridge.alive, scene.bridge.tail()
    scene.check_valid_frames()


def test_the_node_needs_no_more_memory_and_has_logged_no_fault(scene):
    assert scene.bridge.alive
    assert usage_of(scene.bridge.pid)['memory'] - scene.memory < _GROWTH
    with open(scene.bridge.log, errors='replace') as log:
        text = log.read()
    assert 'Traceback' not in text and 'fault in the bridge' not in text, text[-3000:]


def test_until_fails_if_the_condition_stays_false():
    with pytest.raises(AssertionError):
        until(lambda: False, 'never', seconds=0.1)
