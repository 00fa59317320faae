#!/usr/bin/python3
"""The table of parameters agrees with config/bridge.yaml.

This needs no ROS master: run it alone, or with unittest or pytest.
"""
import itertools
import os
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import rosunit
import yaml

from serial_communication.boards import descriptions
from serial_communication.framing.rows import RowError
from serial_communication.ros.parameters import NODE_PARAMETERS, check, parameters_of

PARAMETERS = {**NODE_PARAMETERS, **{
    f'{board.name}/{name}': parameter for board in descriptions()
    for name, parameter in parameters_of(board.binder).items()}}
CONFIG = os.path.join(os.path.dirname(os.path.abspath(__file__)), '..', '..', 'config',
                      'bridge.yaml')


def flatten(tree, prefix=''):
    """Nested groups as one dict, whose names have slashes."""
    flat = {}
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            flat.update(flatten(value, prefix + name + '/'))
        else:
            flat[prefix + name] = value
    return flat


class ParameterTable(unittest.TestCase):
    """config/bridge.yaml, which documents the parameters, and the table that checks them."""

    @classmethod
    def setUpClass(cls):
        with open(CONFIG) as file:
            cls.text = file.read()
        cls.given = yaml.safe_load(cls.text)
        cls.flat = flatten(cls.given)

    def test_the_file_has_every_parameter_and_no_other(self):
        self.assertEqual(set(self.flat), set(PARAMETERS))

    def test_the_file_has_the_defaults_except_for_the_ports(self):
        for name, value in self.flat.items():
            if not name.endswith('/port'):
                with self.subTest(name):
                    default = PARAMETERS[name].default
                    if isinstance(default, float):
                        self.assertAlmostEqual(value / default, 1.0, 12)
                    else:
                        self.assertEqual(value, default)
                    self.assertEqual(isinstance(value, bool), isinstance(default, bool))

    def test_the_file_is_valid(self):
        _node, boards, unknown = check(self.given)
        self.assertEqual(unknown, [])
        self.assertEqual([values['port'] for values in boards.values()],
                         [self.given[link]['port'] for link in ('bus', 'arduino', 'mcu')])

    def test_ports_are_empty_by_default_and_set_in_the_file(self):
        for link in 'bus', 'arduino', 'mcu':
            self.assertEqual(PARAMETERS[link + '/port'].default, '')
            self.assertTrue(self.flat[link + '/port'].startswith('/dev/'))

    def test_the_defaults_of_the_contract(self):
        for name, value in (('bus/environment_period', 1.0), ('arduino/heartbeat_rate', 100.0),
                            ('bus/environment_datelen', 2), ('bus/reply_has_cmd2', False),
                            ('bus/echo', True),
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
                with self.assertRaises(RowError) as caught:
                    check({group: {own: wrong}} if group else {own: wrong})
                text = str(caught.exception)
                self.assertIn('%s is %r' % (name, wrong), text)
                self.assertIn('may be ', text)
                self.assertNotIn('\n', text)

    def test_every_number_with_a_range_refuses_values_just_outside_it(self):
        for name, parameter in PARAMETERS.items():
            if type(parameter.default) not in (int, float) or parameter.choices:
                continue
            group, _, own = name.rpartition('/')
            step = type(parameter.default)(1)
            for value in (parameter.low - step, parameter.high + step):
                value = type(parameter.default)(value)
                with self.subTest(name, value=value), self.assertRaises(RowError):
                    check({group: {own: value}} if group else {own: value})

    def test_a_whole_number_is_accepted_for_a_float(self):
        bus, *_others = check({'bus': {'reply_timeout': 2}})[1].values()
        self.assertEqual(repr(bus['reply_timeout']), '2.0')


class ExternalBoards(unittest.TestCase):
    """Boards of other packages."""

    BOARD = """
from serial_communication.ros.binder import Binder
from . import DESCRIPTION


class BoardBinder(Binder):
    BOARD = DESCRIPTION
"""
    NUMBERS = itertools.count()

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = folder.name
        path = mock.patch.object(sys, 'path', [self.folder, *sys.path])
        path.start()
        self.addCleanup(path.stop)

    def board(self, binder):
        """Create a package with this ros.py; return its import name."""
        package = Path(self.folder, f'external_board_{next(self.NUMBERS)}')
        package.mkdir()
        (package / '__init__.py').write_text(
            'from serial_communication.boards.description import Description\n'
            "DESCRIPTION = Description('wind', __name__, None)\n")
        (package / 'ros.py').write_text(binder)
        return package.name

    def test_a_board_is_accepted_and_what_its_import_raises_passes(self):
        with self.assertRaises(ZeroDivisionError):
            check({'boards': [self.board('1 / 0')]})
        with self.assertRaises(ImportError):
            check({'boards': ['no.such']})
        for boards in ['x', 5], {'a': 'b'}, 'x', [['x']]:
            with self.assertRaisesRegex(RowError, r'may be a list \(names of Python'):
                check({'boards': boards})
        one = self.board(self.BOARD)
        _node, boards, unknown = check({'boards': [one], 'wind': {'baud': 9600, 'own': 1}})
        binder, values = boards.popitem()
        self.assertEqual((binder.BOARD.name, values['baud'], unknown),
                         ('wind', 9600, ['wind/own']))


class Lines(unittest.TestCase):
    """Every error is one readable line, whatever the name or value is."""

    def test_two_links_with_the_same_port_are_refused(self):
        with tempfile.TemporaryDirectory() as folder:
            link = os.path.join(folder, 'by-id')
            os.symlink('/dev/null', link)
            for one, other in (('/dev/null', '/dev/null'), ('/dev/null', link),
                               ('socket://a:1', 'SOCKET://A:1')):
                with self.subTest(other), self.assertRaises(RowError) as caught:
                    check({'bus': {'port': one}, 'mcu': {'port': other, 'baud': 9600}})
                self.assertEqual(str(caught.exception), f"mcu/port is '{other}' (str), is also the "
                                 'port of bus; each link needs its own')
        check({'bus': {'port': 'loop://'}, 'mcu': {'port': 'loop://'}, 'arduino': {'port': ''}})


if __name__ == '__main__':
    rosunit.unitrun('serial_communication', 'parameter_table', '__main__')
