#!/usr/bin/python3
"""wire play and wire stats with bags: a bridge on a desk receives what one on the robot received.
"""
import io
import json
import os
import random
import shutil
import socket
import subprocess
import unittest
from types import SimpleNamespace
from unittest import mock

import rosbag
import rospy
import rostest
from rospy.topics import _PublisherImpl
from sensor_msgs.msg import Imu, Range, Temperature

from boards import PACKAGE, PATIENCE, RX, Bridge, Diagnostics, Line, Topic, own_folder, program
from serial_communication.boards.mcu.wire import SensorStatus
from serial_communication.msg import (McuStatus2, SerialMsg, SteeringFeedback, Ticks, Voltage)
from serial_communication.ros import traffic
from serial_communication.tools.wire.recording import RecordingError, load

SECONDS = 6.0
FRAME_TIMEOUT = 0.3     # s; too long to be reached on a busy machine
FAULTS = {      # of the boards; the silences are longer than frame_timeout
    'bus': ['flip=0.1', 'cut=0.1', 'insert=0.1'],
    'arduino': ['flip=0.01', 'cut=0.01', 'lose=0.01', 'insert=0.01', 'double=0.005',
                'silence=6/min:1.5-1.6'],
    'mcu': ['flip=0.02', 'cut=0.02', 'lose=0.02', 'insert=0.02', 'double=0.02',
            'silence=6/min:1.5-1.6']}
TOPICS = {
    '/serial_communication/imu': Imu, '/serial_communication/imu/temperature': Temperature,
    '/serial_communication/voltage': Voltage, '/serial_communication/ticks': Ticks,
    '/serial_communication/steering_angle': SteeringFeedback,
    '/mcu/status': McuStatus2, '/mcu/imu': Imu, '/mcu/range_1': Range, '/mcu/range_2': Range}


def values(message):
    """All values of a message except its stamp and the counts of errors, which are not played."""
    if hasattr(message, 'header'):
        message.header.stamp, message.header.seq = rospy.Time(), 0
    else:
        message.stamp, message.last_frame_age_sec = rospy.Time(), 0.0
        message.crc_error_count = 0
    packed = io.BytesIO()
    message.serialize(packed)
    return packed.getvalue()


class Session:
    """A bridge with new lines, and a record of all that it publishes."""

    def __init__(self, folder):
        self.lines = {link: Line(os.path.join(folder, link)).plug() for link in FAULTS}
        parameters = {link + '/port': line.near for link, line in self.lines.items()}
        self.bridge = Bridge(parameters=dict(parameters, frame_timeout=FRAME_TIMEOUT))
        self.topics = {name: Topic(name, kind) for name, kind in TOPICS.items()}
        self.frames = Topic('/serial_msg', SerialMsg)
        self.diagnostics = Diagnostics()
        self.diagnostics.wait_for_all(FAULTS, lambda status, link: True, 'anything')
        self.frames.first(lambda message: message.link == 'arduino')     # it is subscribed

    def settle(self):
        """Wait until nothing is received, and incomplete frames have been dropped."""
        def frames_of_boards():
            return sum(message.direction == RX for message in list(self.frames.messages))

        count = -1
        while count != frames_of_boards():
            count = frames_of_boards()
            self.diagnostics.fresh_of_all(FAULTS, lambda status, link: True, 'anything')
            rospy.sleep(2 * FRAME_TIMEOUT)
        self.diagnostics.fresh_of_all(FAULTS, lambda status, link: True, 'anything')

    def errors(self):
        """The error counters, by link and cause."""
        keys = {link: self.diagnostics.statuses(link)[-1].keys for link in FAULTS}
        return {link: {key: value for key, value in keys[link].items()
                       if key.endswith(' errors') or key in ('frames lost', 'frames doubled')}
                for link in FAULTS}

    def said(self):
        """The values on each topic, without the mcu statuses of a silent board."""
        return {name: [values(message) for message in topic.messages
                       if getattr(message, 'connected', True)]
                for name, topic in self.topics.items()}

    def good_frames(self, link):
        """The valid frames of a board."""
        return [message.frame for message in self.frames.messages
                if (message.link, message.direction, message.error) == (link, RX, '')]

    def keep(self, path):
        """Write them to a bag, as rosbag record does."""
        with rosbag.Bag(path, 'w') as bag:
            for message, arrival in zip(self.frames.messages, self.frames.arrivals):
                bag.write('/serial_msg', message, rospy.Time.from_sec(arrival))

    def close(self):
        for topic in list(self.topics.values()) + [self.frames, self.diagnostics]:
            topic.close()
        self.bridge.end()
        for line in self.lines.values():
            line.unplug()


def run(*arguments, **options):
    return subprocess.run([program('wire')] + list(arguments), stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, universal_newlines=True, timeout=PATIENCE * 2,
                          **options)


class WireTest(unittest.TestCase):
    """A recording of three boards with faults, played to another bridge."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.bag = os.path.join(cls.folder, 'robot.bag')
        cls.robot = Session(cls.folder)
        boards = [subprocess.Popen(
            [program('simulator'), link, '--port', cls.robot.lines[link].far, '--seed', '11',
             '--duration', str(SECONDS)]
            + [option for fault in faults for option in ('--fault', fault)],
            stdout=subprocess.DEVNULL) for link, faults in FAULTS.items()]
        for board in boards:
            assert board.wait(SECONDS + PATIENCE) == 0
        cls.robot.settle()
        cls.errors, cls.said = cls.robot.errors(), cls.robot.said()
        cls.robot.close()
        cls.robot.keep(cls.bag)     # nothing more is received that the bag would not have

    @classmethod
    def tearDownClass(cls):
        shutil.rmtree(cls.folder)

    def test_a_damaged_bag_is_reported_in_one_line(self):
        """Wherever and however it is damaged."""
        # rosbag caches the type of a damaged definition for all later bags of this process.
        self.addCleanup(rosbag.bag._message_types.clear)
        path = os.path.join(self.folder, 'damaged.bag')
        with rosbag.Bag(path, 'w') as bag:
            for message in self.robot.frames.messages[:40]:
                bag.write('/serial_msg', message, message.header.stamp)
        with open(path, 'rb') as file:
            whole = file.read()
        chance, refused = random.Random(1), 0
        for _ in range(400):
            damaged = bytearray(whole)
            for _ in range(chance.choice((1, 3, 10))):
                damaged[chance.randrange(len(damaged))] = chance.randrange(256)
            cut = chance.choice((len(whole), chance.randrange(len(whole))))
            with open(path, 'wb') as file:
                file.write(damaged[:cut])
            try:
                load(path)
            except RecordingError as error:
                self.assertEqual(len(str(error).splitlines()), 1)
                refused += 1
            # rosbag caches the type of a damaged definition for the next bag.
            rosbag.bag._message_types.clear()
        self.assertGreater(refused, 100)

    def test_a_bridge_on_a_desk_publishes_what_the_one_on_the_robot_published(self):
        for link, faulty in (('arduino', 'framing errors'), ('mcu', 'checksum errors'),
                             ('mcu', 'frames doubled')):
            self.assertGreater(int(self.errors[link][faulty]), 0, (link, self.errors))
        # A stall of this machine lets a bridge drop what waits. Then it is played once more.
        self.assertTrue(any(self.plays_the_same() for _ in range(3)))

    def plays_the_same(self):
        """Play to a new bridge, and compare; False if this machine stalled that bridge."""
        desk = Session(self.folder)
        try:
            players = {link: subprocess.Popen(
                [program('wire'), 'play', self.bag, link, desk.lines[link].far, '--json',
                 '--frame-timeout', str(FRAME_TIMEOUT)],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True)
                for link in FAULTS}
            for link, player in players.items():    # all three start, and read the bag, at once
                _, trouble = player.communicate(timeout=SECONDS + PATIENCE)
                self.assertEqual(player.returncode, 0, trouble)
                self.assertIn('invalid frames of the bag are left out', trouble)
            desk.settle()
            if any(desk.diagnostics.statuses(link)[-1].keys['stale'] != '0' for link in FAULTS):
                return False
            # Two copies of a frame with a stall between them are two frames.
            if desk.errors()['mcu']['frames doubled'] != self.errors['mcu']['frames doubled']:
                return False
            for link in FAULTS:     # no noise, and no frame with a wrong checksum
                for key in 'checksum errors', 'framing errors':
                    self.assertEqual(desk.errors()[link][key], '0', (link, key))
            said = desk.said()
            for name in TOPICS:
                self.assertGreater(len(self.said[name]), 2, name)
                self.assertEqual(said[name], self.said[name], name)
            for link in FAULTS:     # also of the bus, whose bridge does not take them for replies
                self.assertEqual(desk.good_frames(link), self.robot.good_frames(link), link)
            return True
        finally:
            desk.close()

    def test_stats_of_a_bag_have_the_right_figures(self):
        done = run('stats', self.bag, '--json')
        self.assertEqual(done.returncode, 0, done.stderr)
        links = json.loads(done.stdout)['links']
        for link in FAULTS:
            self.assertEqual(links[link]['from the board']['invalid'], sum(
                1 for message in self.robot.frames.messages
                if (message.link, message.direction) == (link, RX) and message.error))
        # Damaged bytes may pass an XOR, and then are a valid frame of another type.
        types = links['mcu']['from the board']['types']
        good = self.robot.good_frames('mcu')
        self.assertEqual(types['sensor status']['count'],
                         sum(frame[2] == SensorStatus.TYPE for frame in good), types)
        self.assertEqual(sum(each['count'] for each in types.values()), len(good), types)
        self.assertGreater(links['bus']['round trips']['answered'], 2)
        self.assertAlmostEqual(links['arduino']['heartbeats']['gap p50'], 0.01, 2)
        table = run('stats', self.bag)
        for words in ('round trips', 'heartbeats', 'lost, by their SEQ', 'invalid: framing'):
            self.assertIn(words, table.stdout)

    def test_a_recording_of_another_clock_and_topic(self):
        path = os.path.join(self.folder, 'odd.bag')
        with rosbag.Bag(path, 'w') as bag:
            for topic in '/left/serial_msg', '/right/serial_msg':
                for second in (5.0, 6.0, 2.0, 3.0):     # the clock was set back in between
                    message = SerialMsg(link='mcu', direction=RX, type=0x20, frame=b'\2\2\x20\7')
                    message.header.stamp = rospy.Time.from_sec(second)
                    bag.write(topic, message, rospy.Time.from_sec(second))
        done = run('stats', path)
        self.assertEqual(done.returncode, 1)
        self.assertIn('--topic: /left/serial_msg, /right/serial_msg', done.stderr)
        stamps = [each.frame.stamp for each in load(path, '/left/serial_msg').frames]
        self.assertEqual(stamps, sorted(stamps))

    def test_bags_that_cannot_be_played_are_refused(self):
        empty = os.path.join(self.folder, 'empty.bag')
        with rosbag.Bag(empty, 'w') as bag:
            bag.write('/serial_msg', Ticks(), rospy.Time(1))
        cut = os.path.join(self.folder, 'cut.bag')
        with open(self.bag, 'rb') as whole, open(cut, 'wb') as part:
            part.write(whole.read(6000))
        for path, words in ((empty, 'rosbag record'), (cut, 'reindex'),
                            ('/nowhere.bag', 'No such file')):
            done = run('play', path, 'mcu', '/dev/null')
            self.assertEqual(done.returncode, 1)
            self.assertIn(words, done.stderr)
            self.assertEqual(len(done.stderr.splitlines()), 1)


class TrafficTest(unittest.TestCase):
    """Whether the frames are passed on, in orders of rospy's calls that are rare."""

    def setUp(self):
        self.link = SimpleNamespace(name='bus', tap=None)
        self.impl = _PublisherImpl('/serial_msg', SerialMsg)

    def connect(self, name):
        near = socket.socket()
        self.addCleanup(near.close)
        self.impl.add_connection(SimpleNamespace(
            endpoint_id=name, id=name, done=False, socket=near, fileno=near.fileno,
            cleanup_cb=None, close=near.close, set_cleanup_callback=lambda function: None))

    def make(self, _name, _type, subscriber_listener):
        """As rospy: others may subscribe before it has added the listener."""
        if self.is_early:
            self.connect('early')
        self.impl.add_subscriber_listener(subscriber_listener)
        return SimpleNamespace(impl=self.impl, get_num_connections=self.impl.get_num_connections)

    def traffic(self, is_early):
        self.is_early = is_early
        with mock.patch.object(traffic, 'publisher', self.make):
            return traffic.Traffic([self.link], rospy)

    def test_who_subscribes_before_the_listener_is_there_gets_the_frames(self):
        self.traffic(is_early=True)
        self.assertIsNotNone(self.link.tap)

    def test_who_subscribes_as_the_last_one_leaves_gets_the_frames(self):
        listener = self.traffic(is_early=False)
        self.assertIsNone(self.link.tap)
        self.connect('first')
        leave = listener.peer_unsubscribe
        listener.peer_unsubscribe = lambda *left: self.connect('second') or leave(*left)
        self.impl.remove_connection(self.impl.connections[0])
        self.assertIsNotNone(self.link.tap)
        listener.peer_unsubscribe = leave
        self.impl.remove_connection(self.impl.connections[0])
        self.assertIsNone(self.link.tap)


if __name__ == '__main__':
    rospy.init_node('wire_test')
    rostest.rosrun(PACKAGE, 'wire', '__main__')
