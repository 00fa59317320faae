#!/usr/bin/python3
"""What the code says in two places is one: config/bridge.yaml and the table of parameters, the
messages of the car and their topics. Needs no ROS master: run it alone, or with unittest or pytest.
"""
import logging
import os
import re
import time
import unittest
from unittest import mock

import rosunit
import yaml

from serial_communication.protocols import arduino
from serial_communication.ros import arduino as interface
from serial_communication.ros.interface import Common
from serial_communication.ros.parameters import PARAMETERS, ParameterError, check

CONFIG = os.path.join(os.path.dirname(os.path.abspath(__file__)), '..', '..', 'config',
                      'bridge.yaml')


def flatten(tree, prefix=''):
    """Nested groups as names with slashes."""
    flat = {}
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            flat.update(flatten(value, prefix + name + '/'))
        else:
            flat[prefix + name] = value
    return flat


class ParameterTable(unittest.TestCase):
    """The file that documents each parameter, and the table that checks it."""

    @classmethod
    def setUpClass(cls):
        with open(CONFIG) as file:
            cls.text = file.read()
        cls.given = yaml.safe_load(cls.text)
        cls.flat = flatten(cls.given)

    def test_the_file_has_every_parameter_and_no_other(self):
        self.assertEqual(set(self.flat), set(PARAMETERS))

    def test_the_file_has_the_defaults_but_for_the_ports(self):
        for name, value in self.flat.items():
            if not name.endswith('/port'):
                with self.subTest(name):
                    default = PARAMETERS[name].default
                    if isinstance(default, float):
                        self.assertAlmostEqual(value / default, 1.0, 12)
                    else:
                        self.assertEqual(value, default)
                    self.assertEqual(isinstance(value, bool), isinstance(default, bool))

    def test_the_file_is_accepted_as_it_is(self):
        values, warnings = check(self.given, '/node')
        self.assertEqual(warnings, [])
        self.assertEqual(values['bus/port'], self.given['bus']['port'])

    def test_ports_are_empty_by_default_and_set_in_the_file(self):
        for link in 'bus', 'arduino', 'mcu':
            self.assertEqual(PARAMETERS[link + '/port'].default, '')
            self.assertTrue(self.flat[link + '/port'].startswith('/dev/'))

    def test_numbers_that_have_one_say_their_unit(self):
        for name, parameter in PARAMETERS.items():
            if parameter.unit in ('s', 'Hz', 'm', 'rad', 'rad/s', 'm/s^2', 'rad/s per LSB'):
                line = re.search(r'^ *%s:.*$' % name.split('/')[-1], self.text, re.M).group()
                comment = line.partition('#')[2]
                self.assertTrue(re.match(r' %s\b' % re.escape(parameter.unit), comment), line)

    def test_the_defaults_of_the_contract(self):
        for name, value in (('bus/environment_period', 1.0), ('arduino/heartbeat_rate', 100.0),
                            ('bus/environment_datelen', 2), ('bus/reply_has_cmd2', False),
                            ('bus/reply_timeout', 0.5), ('bus/motion_timeout', 5.0),
                            ('bus/retries', 2), ('arduino/speed_timeout', 0.5),
                            ('arduino/check_plausibility', True), ('mcu/timeout', 1.0),
                            ('mcu/yaw_clockwise', True), ('frame_timeout', 0.05),
                            ('bus/baud', 115200), ('arduino/baud', 115200),
                            ('mcu/baud', 115200), ('base_frame_id', 'base_link')):
            self.assertEqual(PARAMETERS[name].default, value, name)

    def test_every_parameter_refuses_the_wrong_type_in_one_line(self):
        for name, parameter in PARAMETERS.items():
            group, _, own = name.rpartition('/')
            wrong = {'a': {}} if isinstance(parameter.default, list) else [1]
            with self.subTest(name):
                with self.assertRaises(ParameterError) as caught:
                    check({group: {own: wrong}} if group else {own: wrong}, '/node')
                text = str(caught.exception)
                self.assertIn('/node/%s is %r' % (name, wrong), text)
                self.assertIn('may be ', text)
                self.assertNotIn('\n', text)

    def test_every_bounded_number_refuses_what_is_just_beyond_its_bounds(self):
        for name, parameter in PARAMETERS.items():
            if type(parameter.default) not in (int, float) or parameter.choices:
                continue
            group, _, own = name.rpartition('/')
            step = type(parameter.default)(1)
            for value in (parameter.low - step, parameter.high + step):
                value = type(parameter.default)(value)
                with self.subTest(name, value=value), self.assertRaises(ParameterError):
                    check({group: {own: value}} if group else {own: value}, '/node')

    def test_a_whole_number_does_for_a_number(self):
        values, _warnings = check({'bus': {'reply_timeout': 2}}, '/node')
        self.assertEqual(repr(values['bus/reply_timeout']), '2.0')


class Sonar(arduino.Ticks):
    """A message that the car could send."""

    TYPE = 99


class Topics(unittest.TestCase):
    """Each message that the car sends has a topic, or the node does not start."""

    @staticmethod
    def interface():
        """One with the default parameters, which opens no port and asks no master."""
        values = {name: each.default
                  for name, each in interface.ArduinoInterface.PARAMETERS.items()}
        values.update(publish_tf=False, frame_prefix='', base_frame_id='base_link')
        with mock.patch.object(interface, 'publisher'), \
                mock.patch.object(interface, 'built_in_topic'):
            return interface.ArduinoInterface(
                values, Common(0.05, time.time, logging.getLogger('table')))

    def test_every_message_of_the_car_has_a_topic(self):
        self.assertEqual(self.interface().link.name, 'arduino')

    def test_one_that_has_none_is_named_before_a_port_is_open(self):
        with mock.patch.object(arduino, 'FROM_BOARD', (*arduino.FROM_BOARD, Sonar)), \
                self.assertRaisesRegex(TypeError, 'messages without a topic: .*Sonar'):
            self.interface()


if __name__ == '__main__':
    rosunit.unitrun('serial_communication', 'parameter_table', '__main__')
