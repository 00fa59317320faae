#!/usr/bin/python3
"""Settings of boards: set with dynamic_reconfigure's own client and `dynparam`, over real ttys."""
import os
import shutil
import subprocess
import unittest

import dynamic_reconfigure.client
import rospy
import rostest

from boards import (PACKAGE, Bridge, CarBoard, Diagnostics, Line, Rosout, again_if_stalled,
                    own_folder, until)
from serial_communication.boards.arduino import DESCRIPTION
from serial_communication.boards.arduino import wire
from serial_communication.simulation.announcing import chunks_of
from serial_communication.framing.stream import SETTING

NAME = '/' + PACKAGE + '/settings/arduino'
ROWS = {
    'kp': {'setting': 1, 'layout': '<f', 'minimum': 0.0, 'maximum': 10.0, 'unit': '1/s',
           'description': 'proportional gain'},
    'ramp': {'setting': 2, 'layout': '<H', 'maximum': 1000, 'unit': 'ms'},
    'reverse': {'setting': 3, 'layout': '<?'},
    'rate': {'setting': 4, 'layout': '<I'},      # which no test sets
}
KINDS = {row.number: row.message for row in DESCRIPTION.read('settings', ROWS)}
GAIN = 'gain: {setting: 7, layout: "<B", minimum: 1, maximum: 9}\n'


class TunableCar(CarBoard):
    """A car that uses and reports its settings, and limits kp to 5."""

    def __init__(self, line):
        self.start_again()
        self.hears = True
        super().__init__(line, KINDS.values())

    def start_again(self):
        """As after a reset."""
        self.values = {1: 1.0, 2: 100, 3: False, 4: 50}

    def take(self, frame):
        super().take(frame)
        message = frame.message
        number = frame.data[0] if frame.type == SETTING else None
        if self.hears and number in self.values:
            self.values[number] = min(round(message[1], 6), 5.0) if number == 1 else message[1]
            self.report(number)

    def report(self, number):
        """Send the value of a setting."""
        self.write(wire.encode(KINDS[number](number, self.values[number])))

    def settings(self):
        """What it has been sent."""
        return [tuple(message) for message in self.messages() if message.TYPE == SETTING]


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
        self.assertEqual({(number, round(value, 6)) for number, value in self.car.settings()},
                         {(1, 2.2), (3, True)})
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


if __name__ == '__main__':
    rospy.init_node('settings_test')
    rostest.rosrun(PACKAGE, 'settings', __name__)
