"""The one bridge of the contract's tests, with three simulated boards and one of another package
at the far ends of socat pairs."""
import atexit
import functools
import os
import shutil
import struct
import tempfile
import unittest
from contextlib import contextmanager
from pathlib import Path

import rospy
import yaml

from boards import (NODE, PACKAGE, Bridge, BusBoard, CarBoard, Diagnostics, Line, Rosout,
                    SensorBoard, Topic, again_if_stalled, command_topic, names_of, service, settle,
                    until)
from by_definition import FUNCTION, LIFT, OK
from serial_communication.boards.arduino import DESCRIPTION

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
LINKS = 'bus', 'arduino', 'mcu', 'wind'
SAMPLE = ROOT / 'doc' / 'wind_sensor'      # the board of another package
# The settings of the car as it has them: its own limit of kp is lower than that of the parameters.
SETTINGS = {'kp': {'setting': 1, 'layout': '<f', 'maximum': 5.0},
            'ramp': {'setting': 2, 'layout': '<H'},
            'reverse': {'setting': 3, 'layout': '<?'},
            'rate': {'setting': 4, 'layout': '<I'},
            'gain': {'setting': 7, 'layout': '<B'}}
FIRMWARE = 'firmware: control 2.0\n'
PUMP = 'valve: {cmd2: 0x40, srv_type: std_srvs/SetBool, request: {layout: "<?", fields: [data]}}\n'
TANK = ('well: {cmd2: 0x41, ros_type: std_msgs/Float32, period: 0.05, '
        'reply: {layout: "<H", fields: [data], scale: 0.1}}\n')


def parameters():
    """The parameters of the bridge: config/custom_messages.yaml and contract.yaml."""
    given = yaml.safe_load((ROOT / 'config' / 'custom_messages.yaml').read_text())
    for name, value in yaml.safe_load((HERE / 'contract.yaml').read_text()).items():
        if name in given:
            value = {**value, **{group: {**rows, **value.get(group, {})}
                                 for group, rows in given[name].items()}}
        given[name] = value
    return given


def resolved(name, node=NODE):
    """The full name of a topic or service, `~x` or `x`."""
    return f'{node}/{name[1:]}' if name[0] == '~' else f'/{name}'


class Robot:
    """Lines, boards, a bridge, and records of its log and its diagnostics."""

    def __init__(self):
        self.folder = tempfile.mkdtemp(prefix='rostest_')
        atexit.register(shutil.rmtree, self.folder)
        self.lines = {link: Line(os.path.join(self.folder, link)) for link in LINKS}
        for line in self.lines.values():
            atexit.register(line.plug().unplug)
        self.start_bus()
        self.start_car()
        self.start_sensors()
        Path(self.folder, 'wind.yaml').write_text(
            (SAMPLE / 'wind.yaml').read_text().replace('/tmp/wind', self.lines['wind'].near))
        self.python_path = f'{SAMPLE.parent}:{os.environ["PYTHONPATH"]}'
        self.rosout, self.diagnostics = Rosout(), Diagnostics()
        self.parameters = parameters()
        for link, line in self.lines.items():
            self.parameters.setdefault(link, {})['port'] = line.near
        self.bridge = Bridge(parameters=self.parameters, PYTHONPATH=self.python_path)
        atexit.register(self.bridge.kill)
        until(lambda: resolved('~stop') in names_of()[2] or not self.bridge.alive,
              'the bridge is complete')
        assert self.bridge.alive, self.bridge.output()
        until(lambda: resolved('~well') in names_of()[0], 'the bus board announces')
        until(self.car.heartbeats, 'a heartbeat')

    def start_bus(self, announcement=FIRMWARE + PUMP + TANK):
        """Start the control board, which announces these rows."""
        self.bus = BusBoard(self.lines['bus'].far, announcement=announcement.encode())
        self.bus.data = {0x32: pack('H', 10132), 0x41: pack('H', 15)}     # what is polled

    def start_car(self):
        """Start the car."""
        self.car = CarBoard(self.lines['arduino'].far, measures=True, calibration_time=3.0,
                            settings=DESCRIPTION.read('settings', SETTINGS))

    def start_sensors(self):
        """Start the sensor board."""
        self.sensors = SensorBoard(self.lines['mcu'].far, measures=True)


@functools.lru_cache(maxsize=None)
def robot():
    """The robot of all tests."""
    return Robot()


class Contract(unittest.TestCase):
    """Tests of the one bridge; each leaves it as it was."""

    @classmethod
    def setUpClass(cls):
        cls.robot = robot()
        cls.diagnostics, cls.rosout = cls.robot.diagnostics, cls.robot.rosout

    bus = property(lambda self: self.robot.bus)     # the board of now
    car = property(lambda self: self.robot.car)
    sensors = property(lambda self: self.robot.sensors)

    def setUp(self):
        self.rosout.forget()
        self.car.forget()

    def topic(self, name, message_class, wait=True):
        """A record of a topic, `~x` or `x`, until the test ends."""
        topic = Topic(resolved(name), message_class, wait)
        self.addCleanup(topic.close)
        return topic

    def command(self, name, message_class):
        """A publisher, until the test ends."""
        topic = command_topic(resolved(name), message_class)
        self.addCleanup(topic.unregister)
        return topic

    @contextmanager
    def unplugged(self, *links):
        """Cut these lines, and have them noticed when the block begins; connect them at its end."""
        self.diagnostics.forget()
        for link in links:
            self.robot.lines[link].unplug()
        try:
            yield [self.until_condition(link, lambda name: name == 'closed') for link in links]
        finally:
            self.diagnostics.forget()
            for link in links:
                self.robot.lines[link].plug()
        for link in links:
            self.until_condition(link, lambda name: name != 'closed')

    def until_condition(self, link, condition):
        """Wait until a link has such a condition, by /diagnostics; return the status."""
        return self.diagnostics.wait_for(link, lambda status: condition(status.keys['condition']),
                                         'another condition', is_fresh=False)

    def reconnects(self, link):
        """How often the bridge has opened a port again, by a new status."""
        return int(self.diagnostics.wait_for(link, lambda status: True, 'keys').keys['reconnects'])

    def service(self, name, service_class):
        """A service of the bridge."""
        return service(resolved(name), service_class)

    def answered(self, call, *arguments, reply=None, cmd2=LIFT, status=OK):
        """The answer to a call of the bus that has this status; the board's reply to this function
        is given, if it is not the usual one.

        It is made again if a stall of this machine kept it back or dropped the reply.
        """
        def answer():
            settle(PACKAGE, self.bus)
            self.bus.rule = lambda request: reply if request[:2] == (FUNCTION, cmd2) else None
            found = call(*arguments)
            return found if found.status == status else print(found)
        return again_if_stalled(answer)

    def until_on_the_wire(self, packet, doing):
        """Wait until the car gets these bytes, called `doing` again and again."""
        until(lambda: packet in self.car.wire, f'{packet.hex()} on the wire', doing=doing,
              every=0.05)

    def assert_service_error(self, words, call, *arguments):
        """A call raises an error with these words; with others if this machine stalls."""
        def raised():
            with self.assertRaises(rospy.ServiceException) as caught:
                call(*arguments)
            return words in str(caught.exception) or print(caught.exception)
        until(raised, f'a service error with "{words}"', every=0.1)

    def assert_values(self, values, expected, places=6):
        """Numbers have these values."""
        self.assertEqual(len(values), len(expected))
        for value, wanted in zip(values, expected):
            self.assertAlmostEqual(value, wanted, places)


def pack(layout, *values):
    """Bytes, little-endian."""
    return struct.pack('<' + layout, *values)
