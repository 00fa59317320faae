"""The forms of custom commands and functions: their fields with limits, and what is refused."""
import pytest
from std_srvs.srv import SetBool

from serial_communication.srv import Lift
from serial_communication.tools.panel import forms
from serial_communication.tools.panel.dead_man import CommandRefused
from serial_communication.tools.watch.topics import boards_of

ROWS = {
    'gripper': {'type': 40, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Vector3',
                'layout': '<hhB', 'fields': ['x', '', 'z'], 'scale': [0.1, 1, 1],
                'minimum': [-10, 0, 0], 'maximum': [10, 0, 3]},
    'horn': {'type': 41, 'direction': 'to_board', 'ros_type': 'std_msgs/Bool', 'layout': '<?',
             'fields': ['data']},
    'tone': {'type': 42, 'direction': 'to_board', 'ros_type': 'std_msgs/String', 'layout': '<4s',
             'fields': ['data']},
    'path': {'type': 43, 'direction': 'to_board', 'ros_type': 'std_msgs/Int16MultiArray',
             'layout': '<h*', 'fields': ['data'], 'maximum': 100},
    'force': {'type': 44, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data']},
    'unknown': {'type': 45, 'direction': 'to_board', 'ros_type': 'nowhere/Type', 'layout': '<h',
                'fields': ['data']},
    'wrong': {'direction': 'to_board'}}


@pytest.fixture
def messages():
    return forms.custom_messages(boards_of({}), {'arduino': {'messages': ROWS}})


def field(name, kind, low, high, whole=False):
    return {'name': name, 'kind': kind, 'low': low, 'high': high, 'whole': whole, 'unit': ''}


def test_only_valid_rows_to_the_board_are_offered_with_their_limits(messages):
    assert {name: each.link for name, each in messages.items()} == dict.fromkeys(
        ['~gripper', '~horn', '~tone', '~path'], 'arduino')
    assert messages['~gripper'].fields == [
        field('x', 'number', -10, 10), field('z', 'number', 0, 3, whole=True)]
    assert messages['~horn'].fields == [field('data', 'bool', 0, 1, whole=True)]
    assert messages['~tone'].fields == [field('data', 'text', None, None)]
    assert messages['~path'].fields == [field('data', 'array', -32768, 100, whole=True)]


def test_the_services_of_the_boards_are_those_of_their_descriptions():
    services = forms.board_services(boards_of({}))
    assert {name: (each.link, each.title) for name, each in services.items()} == {
        '~lift': ('bus', 'lift'), '~gimbal': ('bus', 'gimbal'), '~bus/echo': ('bus', 'echo'),
        '~bus/sync': ('bus', 'sync'), '~calibrate_imu': ('arduino', 'calibrate the IMU'),
        '~arduino/reset': ('arduino', 'reset the board'), '~mcu/reset': ('mcu', 'reset the board')}
    direction, distance = services['~lift'].fields
    assert distance == {**field('distance', 'number', 1, 255, whole=True), 'unit': 'mm',
                        'preset': 20, 'choices': ()}
    assert dict(direction['choices']) == {'▲ up': 0, '▼ down': 1}
    assert services['~calibrate_imu'].confirm.startswith('The car must not move')
    assert services['~arduino/reset'].confirm.startswith('The car stops')
    assert services['~mcu/reset'].confirm and not services['~bus/sync'].confirm


def test_a_service_has_the_limits_of_its_types_narrowed_by_its_row():
    assert forms.service(Lift, 'bus').fields == [
        field('direction', 'number', 0, 255, whole=True),
        field('distance', 'number', 0, 255, whole=True)]
    rows = {'pump': {'cmd2': 48, 'srv_type': 'std_srvs/SetBool',
                     'request': {'layout': '<B', 'fields': ['data']}},
            'turn': {'cmd2': 49, 'srv_type': 'serial_communication/Lift',
                     'request': {'layout': '<BB', 'fields': ['direction', 'distance'],
                                 'maximum': [1, 90]}},
            'unknown': {'cmd2': 50, 'srv_type': 'nowhere/Type'}}
    services = forms.custom_services(boards_of({}), {'bus': {'functions': rows}})
    assert sorted(services) == ['~pump', '~turn'] and services['~pump'].service_class is SetBool
    assert [(each['kind'], each['high']) for each in services['~pump'].fields] == [('bool', 255)]
    assert [each['high'] for each in services['~turn'].fields] == [1, 90]


def test_values_become_a_message(messages):
    assert messages['~gripper'].make({'x': -2.5, 'z': 3}).x == -2.5
    assert messages['~horn'].make({'data': True}).data is True
    assert messages['~tone'].make({'data': 'a\u00e4'}).data == 'a\u00e4'
    assert list(messages['~path'].make({'data': [1, -2]}).data) == [1, -2]


@pytest.mark.parametrize('name, values, words', [
    ('~gripper', {'x': 1}, 'gripper takes x, z'), ('~gripper', {'x': 1, 'z': 1, 'y': 1}, 'takes'),
    ('~gripper', {'x': 10.5, 'z': 1}, 'x is 10.5, out of range (-10 \u2026 10)'),
    ('~gripper', {'x': '1', 'z': 1}, 'gripper: '), ('~gripper', {'x': {}, 'z': 1}, 'gripper: '),
    ('~gripper', {'x': None, 'z': 1}, 'gripper: '), ('~path', {'data': [1, 101]}, 'data is 101'),
    ('~path', {'data': ['a']}, 'path: '), ('~path', {'data': 5}, 'path: '),
    ('~tone', {'data': 'too long'}, 'tone: '), ('~tone', {'data': 5}, 'tone: '),
    ('~tone', {'data': 'a\0b'}, 'tone: '), ('~gripper', {'x': 10 ** 400, 'z': 1}, 'gripper: ')])
def test_values_that_do_not_fit_are_refused(messages, name, values, words):
    with pytest.raises(CommandRefused) as refused:
        messages[name].make(values)
    assert words in str(refused.value)
