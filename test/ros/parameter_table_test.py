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

from serial_communication.ros.parameters import PARAMETERS, ParameterError, check

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
        values, warnings = check(self.given, '/node')
        self.assertEqual(warnings, [])
        self.assertEqual(values['bus/port'], self.given['bus']['port'])

    def test_ports_are_empty_by_default_and_set_in_the_file(self):
        for link in 'bus', 'arduino', 'mcu':
            self.assertEqual(PARAMETERS[link + '/port'].default, '')
            self.assertTrue(self.flat[link + '/port'].startswith('/dev/'))

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

    def test_every_number_with_a_range_refuses_values_just_outside_it(self):
        for name, parameter in PARAMETERS.items():
            if type(parameter.default) not in (int, float) or parameter.choices:
                continue
            group, _, own = name.rpartition('/')
            step = type(parameter.default)(1)
            for value in (parameter.low - step, parameter.high + step):
                value = type(parameter.default)(value)
                with self.subTest(name, value=value), self.assertRaises(ParameterError):
                    check({group: {own: value}} if group else {own: value}, '/node')

    def test_a_whole_number_is_accepted_for_a_float(self):
        values, _warnings = check({'bus': {'reply_timeout': 2}}, '/node')
        self.assertEqual(repr(values['bus/reply_timeout']), '2.0')


class ExternalBoards(unittest.TestCase):
    """Boards of other packages, and mistakes in them."""

    BOARD = """
from serial_communication.ros.interface import Interface
from serial_communication.ros.parameter import BAUD, PORT, Parameter


class INTERFACE(Interface):
    NAME = 'wind'
    PARAMETERS = {'port': PORT, 'baud': BAUD}
"""
    NUMBERS = itertools.count()

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = folder.name
        path = mock.patch.object(sys, 'path', [self.folder, *sys.path])
        path.start()
        self.addCleanup(path.stop)

    def module(self, text):
        """Create a module with this text, which records each import; return its name."""
        name = f'external_board_{next(self.NUMBERS)}'
        Path(self.folder, name + '.py').write_text(
            f"open(__file__ + '.imports', 'a').write('x')\n{text}\n")
        return name

    def board(self, interface, name='wind'):
        """Create a package with this ros.py (None: without one); return its import name."""
        package = Path(self.folder, f'external_board_{next(self.NUMBERS)}')
        package.mkdir()
        (package / '__init__.py').write_text(
            'from serial_communication.boards.description import Description\n'
            f'DESCRIPTION = Description({name!r}, __name__, None)\n')
        if interface is not None:
            (package / 'ros.py').write_text(interface)
        return package.name

    def assert_refused(self, given, *said):
        with self.assertRaises(ParameterError) as caught:
            check(given, '/node')
        text = str(caught.exception)
        for words in said:
            self.assertIn(words, text)
        self.assertNotIn('\n', text)
        return text

    def test_an_error_of_the_import_is_one_line_with_its_place_and_there_is_one_import(self):
        for body, said in (
                ('1 / 0', 'ZeroDivisionError: division by zero (%s, line 2)'),
                ('raise KeyboardInterrupt', 'KeyboardInterrupt (%s, line 2)'),
                ('import sys; sys.exit(3)', 'SystemExit: 3 (%s, line 2)'),
                ('exit()', 'SystemExit: None ('),
                ('raise BaseException("a\\nb")', 'BaseException: a b (%s, line 2)'),
                ('raise ValueError("x" * 10**6)', 'ValueError: xxx'),
                ('import no_such_module', "ModuleNotFoundError: No module named 'no_such_module' "
                 '(%s, line 2)'),
                ('import signal; signal.signal(2, signal.SIG_IGN)', 'ValueError: signal only'),
                ('class Unspeakable(Exception):\n    def __str__(self): return 5\n'
                 'raise Unspeakable', '')):
            with self.subTest(body):
                name = self.module(body)
                path = os.path.join(self.folder, name + '.py')
                text = self.assert_refused(
                    {'boards': [name]}, f"parameter /node/boards is ['{name}'] (list), may be a "
                    f"list (names of Python packages with a board): importing '{name}' failed: "
                    + (said % path if '%s' in said else said))
                self.assertLess(len(text), 700)
                with open(path + '.imports') as file:
                    self.assertEqual(file.read(), 'x')
        with open(os.path.join(self.folder, 'unfinished.py'), 'w') as file:
            file.write('1 +')
        self.assert_refused({'boards': ['unfinished']}, 'SyntaxError', 'unfinished.py, line 1)')

    def test_names_that_are_not_module_names_are_refused(self):
        for name in '', '.', '.x', 'no.such', 'a/b', 'a\nb', 'x' * 10**5, '\0':
            with self.subTest(name[:9]):
                self.assert_refused({'boards': [name]}, 'parameter /node/boards is [', 'importing')
        for boards in ['x', 5], {'a': 'b'}, 'x', [['x']]:
            self.assert_refused({'boards': boards}, 'may be a list (names of Python packages with')

    def test_a_wrong_interface_is_refused(self):
        for text, said in (
                ('', 'its ros.py has no INTERFACE'),
                ('INTERFACE = None', 'its ros.py has no INTERFACE'),
                ('INTERFACE = 5', 'INTERFACE is 5, may be a class derived from'),
                ('class INTERFACE: NAME = "wind"', 'may be a class derived from'),
                (self.BOARD + '    del NAME', 'INTERFACE.NAME is None, may be letters'),
                (self.BOARD + '    NAME = 5', 'INTERFACE.NAME is 5, may be letters'),
                (self.BOARD + '    NAME = "a/b"', "INTERFACE.NAME is 'a/b', may be letters"),
                (self.BOARD + '    NAME = "bus"', "NAME is 'bus', may be a name that no other"),
                (self.BOARD + '    NAME = "boards"', "NAME is 'boards', may be a name that no"),
                (self.BOARD + '    del PARAMETERS', 'INTERFACE.PARAMETERS is None, may be a dict'),
                (self.BOARD + '    PARAMETERS = [PORT]', 'may be a dict from name to Parameter'),
                (self.BOARD + '    PARAMETERS = {5: PORT}', 'from name (letters, digits'),
                (self.BOARD + '    PARAMETERS = {"port": "x"}', "['port'] is 'x', may be a Param"),
                (self.BOARD + '    PARAMETERS = {"baud": BAUD}', "['port'] is None, may be PORT"),
                (self.BOARD + '    PARAMETERS = {"port": BAUD}', 'may be PORT'),
                (self.BOARD + '    PARAMETERS["x"] = Parameter(None)', "['x'].default is None,"),
                (self.BOARD + '    PARAMETERS["x"] = Parameter({})', "['x'].parse is None, may"),
                (self.BOARD + '    MOUNTS = ("imu",)', 'PARAMETERS has no imu_frame_id'),
                (self.BOARD + '    MOUNTS = 5', 'INTERFACE.MOUNTS is 5, may be a tuple')):
            with self.subTest(said, text=text[len(self.BOARD):]):
                name = self.board(text)
                self.assert_refused({'boards': [name]}, 'parameter /node/boards is',
                                    f"the module '{name}'", said)

    def test_a_board_is_accepted_and_a_wrong_package_is_refused(self):
        for interface, name, said in (
                (self.BOARD, 'rain', "INTERFACE.NAME is 'wind', may be 'rain', the name in its "
                 'DESCRIPTION'),
                ('1 / 0', 'wind', ".ros' failed: ZeroDivisionError: division by zero ("),
                (None, 'wind', ".ros' failed: ModuleNotFoundError")):
            with self.subTest(said):
                self.assert_refused({'boards': [self.board(interface, name)]},
                                    'parameter /node/boards is', said)
        for text in '', 'DESCRIPTION = 5', self.BOARD:     # the last one was a board up to 1.1
            self.assert_refused({'boards': [self.module(text)]}, 'has no DESCRIPTION of a board')
        one, other = self.board(self.BOARD), self.board(self.BOARD)
        for boards in [one, one], [one, other]:
            self.assert_refused({'boards': boards}, "INTERFACE.NAME is 'wind', may be a name that "
                                'no other board')
        values, warnings = check({'boards': [one], 'wind': {'baud': 9600}}, '/node')
        self.assertEqual((values['boards'][-1].NAME, values['wind/baud'], warnings),
                         ('wind', 9600, []))

    def test_rows_that_a_board_announced_in_an_earlier_run_are_no_unknown_parameter(self):
        given = {'boards': [self.board(self.BOARD)], 'wind': {'announced': {'gust': {}}}}
        self.assertEqual(check(given, '/node')[1], [])
        given['boards'] = [self.board(self.BOARD + '    PARAMETERS["announced"] = Parameter(5)')]
        self.assert_refused(given, 'wind/announced is')

    def test_any_error_in_a_boards_own_checks_is_one_line(self):
        fault = '(lambda *_: 1 / 0)'
        for text, said in (
                ('    problem = staticmethod' + fault, 'parameter /node/boards: the board wind '
                 'failed to check its parameters: ZeroDivisionError'),
                ('    custom_names = staticmethod' + fault, 'the board wind failed to check its'),
                ('    custom_names = staticmethod(lambda p: 5)',
                 'the board wind failed to check its'),
                (f'    PARAMETERS["x"] = Parameter("a", parse={fault})', "parameter /node/wind/x "
                 "is 'a' (str), may be text: ZeroDivisionError: division by zero (")):
            with self.subTest(text):
                self.assert_refused({'boards': [self.board(self.BOARD + text)]}, said)


class Lines(unittest.TestCase):
    """Every error is one readable line, whatever the name or value is."""

    def test_two_links_with_the_same_port_are_refused(self):
        with tempfile.TemporaryDirectory() as folder:
            link = os.path.join(folder, 'by-id')
            os.symlink('/dev/null', link)
            for one, other in (('/dev/null', '/dev/null'), ('/dev/null', link),
                               ('socket://a:1', 'SOCKET://A:1')):
                with self.subTest(other), self.assertRaises(ParameterError) as caught:
                    check({'bus': {'port': one}, 'mcu': {'port': other, 'baud': 9600}}, '/node')
                self.assertEqual(str(caught.exception), f"parameter /node/mcu/port is '{other}', "
                                 f"which is also the port of /node/bus/port ('{one}'); each link "
                                 'needs its own port')
        check({'bus': {'port': 'loop://'}, 'mcu': {'port': 'loop://'}, 'arduino': {'port': ''}},
              '/node')


if __name__ == '__main__':
    rosunit.unitrun('serial_communication', 'parameter_table', '__main__')
