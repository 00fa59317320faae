#!/usr/bin/python3
"""Settings of boards: set with dynamic_reconfigure's own client and `dynparam`, over real ttys."""
import math
import os
import shutil
import subprocess
import sys
import unittest
from types import SimpleNamespace
from unittest import mock

import dynamic_reconfigure.client
import rospy
import rostest

from boards import (PACKAGE, Bridge, CarBoard, Diagnostics, Line, Master, Rosout, again_if_stalled,
                    own_folder, until)
from serial_communication.boards.arduino import DESCRIPTION
from serial_communication.boards.arduino import wire
from serial_communication.framing.announcement import chunks_of
from serial_communication.framing.settings import SettingMessage, message_of
from serial_communication.link.settings import BoardSettings
from serial_communication.link.sparing_log import SparingLog
from serial_communication.ros.settings import SettingsServer

NAME = '/' + PACKAGE + '/settings/arduino'
ROWS = {
    'kp': {'setting': 1, 'layout': '<f', 'minimum': 0.0, 'maximum': 10.0, 'unit': '1/s',
           'description': 'proportional gain'},
    'ramp': {'setting': 2, 'layout': '<H', 'maximum': 1000, 'unit': 'ms'},
    'reverse': {'setting': 3, 'layout': '<?'},
    'rate': {'setting': 4, 'layout': '<I'},      # which no test sets
}
KIND = message_of(DESCRIPTION.read('settings', ROWS))
GAIN = 'gain: {setting: 7, layout: "<B", minimum: 1, maximum: 9}\n'


class TunableCar(CarBoard):
    """A car that uses and reports its settings, and limits kp to 5."""

    def __init__(self, line):
        self.start_again()
        self.hears = True
        super().__init__(line, [KIND])

    def start_again(self):
        """As after a reset."""
        self.values = {1: 1.0, 2: 100, 3: False, 4: 50}

    def take(self, frame):
        super().take(frame)
        message = frame.message
        if isinstance(message, SettingMessage) and self.hears and message.number in self.values:
            self.values[message.number] = min(message.value, 5.0) if message.number == 1 else \
                message.value
            self.report(message.number)

    def report(self, number):
        """Send the value of a setting."""
        self.write(wire.encode(KIND(number, self.values[number])))

    def settings(self):
        """What it has been sent."""
        return [tuple(message) for message in self.messages(SettingMessage)]


class SettingsTest(unittest.TestCase):
    """A bridge whose car has settings."""

    ROWS = ROWS

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.line = Line(os.path.join(cls.folder, 'arduino')).plug()
        cls.car = TunableCar(cls.line.far)
        cls.bridge = Bridge(parameters={
            'arduino/port': cls.line.near, 'arduino/settings': ROWS,
            'settings': {'arduino': {'ramp': 250}}})
        cls.rosout, cls.diagnostics = Rosout(), Diagnostics()
        cls.client = dynamic_reconfigure.client.Client(NAME, timeout=30)
        cls.car.wait_for_heartbeats(1)

    @classmethod
    def tearDownClass(cls):
        cls.client.close()
        cls.bridge.end()
        for part in cls.rosout, cls.diagnostics, cls.car:
            part.close()
        cls.line.unplug()
        shutil.rmtree(cls.folder)

    def setUp(self):
        self.car.hears = True
        self.until_published(
            lambda values: values.ramp == 250 and values.kp == self.car.values[1], *self.car.values)
        self.car.forget()

    def until_published(self, are_right, *reported):
        """Wait for right values; the car reports these numbers until then, since a stall of this
        machine drops what it sends."""
        def published():
            values = self.client.get_configuration(timeout=1.0)
            return values and are_right(values)
        until(published, 'these values', every=0.1,
              doing=lambda: [self.car.report(number) for number in reported])

    def keys(self):
        return self.diagnostics.fresh('arduino', lambda status: True, 'a status').keys

    def test_a_parameter_is_the_wanted_value_at_the_start(self):
        self.assertEqual(self.car.values[2], 250)

    def test_the_rows_are_shown_with_limits_unit_and_description(self):
        shown = {each['name']: each for each in self.client.get_parameter_descriptions()}
        kp, ramp, reverse = (shown[name] for name in ('kp', 'ramp', 'reverse'))
        self.assertEqual((kp['type'], kp['min'], kp['max'], kp['description']),
                         ('double', 0.0, 10.0, 'proportional gain [1/s]'))
        self.assertEqual((ramp['type'], ramp['min'], ramp['max']), ('int', 0, 1000))
        self.assertEqual(reverse['type'], 'bool')

    def test_a_set_returns_what_the_board_confirmed(self):
        values = self.client.update_configuration({'kp': 2.2, 'reverse': True})
        self.assertEqual((values.kp, values.reverse, values.ramp), (2.2, True, 250))
        self.assertEqual(set(self.car.settings()), {(1, 2.2), (3, True)})
        until(lambda: rospy.get_param(NAME + '/kp', None) == 2.2, 'the parameter')
        self.assertFalse(rospy.has_param(NAME + '/nothing'))

    def test_a_value_over_the_limit_of_the_row_or_of_the_board_comes_back_limited(self):
        def comes_back_limited():
            return self.client.update_configuration({'kp': 9.0}).kp == 5.0

        again_if_stalled(comes_back_limited)
        self.rosout.wait_for(PACKAGE, 'kp cannot be 9.0: the board uses 5.0',
                             doing=comes_back_limited)
        self.assertEqual(self.client.update_configuration({'ramp': 5000}).ramp, 1000)
        self.client.update_configuration({'ramp': 250})
        self.diagnostics.wait_for('arduino', lambda status: status.keys[
            'settings unconfirmed'] == '', 'all are confirmed')

    def test_a_refused_value_makes_nothing_wanted(self):
        rate = self.car.values[4]
        self.until_published(lambda values: values.rate == rate)
        self.assertEqual(self.client.update_configuration({'rate': math.nan}).rate, rate)
        self.rosout.wait_for(PACKAGE, 'the setting rate cannot be nan')
        before = self.car.values[3]
        for value in not before, before:
            self.client.update_configuration({'reverse': value})
            until(lambda value=value: rospy.get_param(NAME + '/reverse', None) == value,
                  'the next parameter')
        self.assertFalse(rospy.has_param(NAME + '/rate'))
        self.assertNotIn(4, [number for number, _ in self.car.settings()])

    def test_dynparam(self):
        def dynparam(*arguments):
            return subprocess.check_output(['rosrun', 'dynamic_reconfigure', 'dynparam',
                                            *arguments], timeout=60).decode()

        dynparam('set', NAME, 'kp', '4.5')
        self.assertEqual(self.car.values[1], 4.5)
        self.assertIn("'kp': 4.5", dynparam('get', NAME))
        self.assertIn(NAME, dynparam('list').splitlines())

    def test_settings_come_and_go_with_an_announcement(self):
        before = set(self.client.get_configuration()) - {'groups'}

        def announce(text):
            for chunk in chunks_of(text.encode(), 60):
                self.car.say(chunk)

        self.rosout.wait_for(PACKAGE, 'announces gain', doing=lambda: announce(GAIN))
        until(lambda: 'gain' in self.client.get_configuration() and 'gain' in [
            each['name'] for each in self.client.get_parameter_descriptions()], 'gain comes')
        until(lambda: self.client.get_configuration().gain == 4, 'its value', every=0.1,
              doing=lambda: self.car.write(wire.encode_raw(253, b'\7\4')))
        self.assertEqual(self.client.update_configuration({'gain': 8}).gain, 8)
        self.assertIn((7, (8,)), self.car.settings())
        self.rosout.forget()
        self.rosout.wait_for(PACKAGE, 'announces nothing', doing=lambda: announce(''))
        until(lambda: set(self.client.get_configuration()) - {'groups'} == before, 'gain goes')

    def test_an_announced_row_loses_against_one_of_the_parameters(self):
        text = 'kp: {setting: 1, layout: "<h"}\n'
        self.rosout.wait_for(PACKAGE, 'arduino/settings/kp has the same name, differs',
                             doing=lambda: [self.car.say(chunk) for chunk in
                                            chunks_of(text.encode(), 60)])


class ServerTest(unittest.TestCase):
    """The settings of a link in this process, without a board."""

    def setUp(self):
        self.name = rospy.resolve_name('~settings/arduino')
        self.added = []

    def tearDown(self):
        self.end()
        if rospy.has_param(self.name):
            rospy.delete_param(self.name)

    def start(self, rows):
        """As a node starts."""
        self.kinds, self.log = [], mock.Mock()
        self.settings = BoardSettings(SparingLog('arduino', self.log), self.kinds.append,
                                      lambda: None, lambda: 0.0)
        rows = DESCRIPTION.read('settings', rows)
        link = SimpleNamespace(name='arduino', board_settings=self.settings, log=self.log)
        values = rospy.get_param('~settings', {}).get('arduino', {})
        SettingsServer(link, rows, values, SimpleNamespace(submit=lambda function: function()))
        self.added = [self.settings.add(row) for row in rows]

    def end(self):
        while self.added:
            self.added.pop()()

    def test_what_a_limit_is_rounded_to_is_a_parameter_of_the_next_start(self):
        rows = {'angle': {'setting': 1, 'layout': '<f', 'minimum': -3.14159265,
                          'maximum': 3.14159265}}
        for limit, rounded in (-3.14159265, -3.1415927), (3.14159265, 3.1415927):
            self.start(rows)
            self.settings.want('angle', limit)
            self.assertEqual(rospy.get_param(self.name + '/angle'), rounded)
            self.end()
            self.start(rows)
            self.assertEqual(self.settings.shown()['angle'], (None, rounded, False))
            self.end()


class OtherBridges(unittest.TestCase):
    """Bridges of their own."""

    def setUp(self):
        self.folder = own_folder()
        self.addCleanup(shutil.rmtree, self.folder)

    def bridge(self, parameters, **options):
        bridge = Bridge('other', parameters, **options)
        self.addCleanup(bridge.kill)
        return bridge

    def test_a_wrong_value_ends_the_node_with_one_line(self):
        for value, words in (({'kp': 11.0}, 'settings/arduino/kp is 11.0 .*may be a number from 0'),
                             ({'kp': 'fast'}, 'settings is .*may be values by link and name')):
            bridge = self.bridge({'arduino/port': self.folder + '/none', 'arduino/settings': ROWS,
                                  'settings': {'arduino': value}})
            self.assertRegex(bridge.wait_for('parameter /other/settings'), words)

    def test_a_new_master_has_the_server_and_the_values(self):
        line = Line(os.path.join(self.folder, 'car')).plug()
        self.addCleanup(line.unplug)
        car = TunableCar(line.far)
        self.addCleanup(car.close)
        master = Master().start()
        self.addCleanup(master.end)
        self.bridge({'arduino/port': line.near, 'arduino/settings': ROWS}, master=master.uri)
        set_kp = [sys.executable, '-c', (
            'import rospy, sys\n'
            'from dynamic_reconfigure.client import Client\n'
            'rospy.init_node("setter", anonymous=True)\n'
            'client = Client("/other/settings/arduino", timeout=60)\n'
            'print(client.update_configuration({"kp": float(sys.argv[1])}).kp)\n')]
        environment = dict(os.environ, ROS_MASTER_URI=master.uri)

        def answer(value):
            return float(subprocess.check_output(set_kp + [str(value)], env=environment,
                                                 timeout=90))

        self.assertEqual(answer(2.0), 2.0)
        until(lambda: master.server.hasParam('/other/settings/arduino/kp'), 'it is set')
        master.end()
        master.start()
        until(lambda: master.server.hasParam('/other/settings/arduino/kp'), 'it is set again')
        self.assertEqual(master.server.getParam('/other/settings/arduino/kp'), 2.0)
        self.assertEqual(answer(3.0), 3.0)


if __name__ == '__main__':
    rospy.init_node('settings_test')
    rostest.rosrun(PACKAGE, 'settings', __name__)
