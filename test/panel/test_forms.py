"""The forms: their fields with limits, and what is refused."""
import pytest
from serial_communication.tools.panel.driving import CommandRefused
from serial_communication.tools.panel.forms import forms
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
    'cmd_vel': {'type': 46, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist',
                'layout': '<hh', 'fields': ['linear.x', 'angular.z'], 'scale': 0.001},
    'force': {'type': 44, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data']},
    'unknown': {'type': 45, 'direction': 'to_board', 'ros_type': 'nowhere/Type', 'layout': '<h',
                'fields': ['data']},
    'wrong': {'direction': 'to_board'}}
SETTINGS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10, 'unit': '1/s'},
            'free': {'setting': 3, 'layout': '<f'}, 'wrong': {'setting': 300, 'layout': '<f'}}
FUNCTIONS = {'turn': {'cmd2': 49, 'srv_type': 'serial_communication/Lift',
                      'request': {'layout': '<BB', 'fields': ['direction', 'distance'],
                                  'maximum': [1, 90]}},
             'level': {'cmd2': 51, 'ros_type': 'std_msgs/UInt8', 'period': 1,
                       'reply': {'layout': '<B', 'fields': ['data']}}}


@pytest.fixture
def found():
    return forms(boards_of({}), {
        'arduino': {'messages': ROWS, 'settings': SETTINGS,
                    'announced': {'rate': {'setting': 4, 'layout': '<H'}}},
        'bus': {'functions': FUNCTIONS}})


def limits(form):
    return [(each['name'], each['kind'], each['low'], each['high']) for each in form.fields]


def test_each_command_of_the_boards_has_a_form_and_what_is_wrong_has_none(found):
    assert set(found) == {
        '~lift', '~gimbal', '~bus/echo', '~bus/sync', '~calibrate_imu', '~arduino/reset',
        '~mcu/reset', '~speed', '~steering', '~led', '~gripper', '~horn', '~tone', '~path',
        '~cmd_vel', '~settings/arduino/kp', '~settings/arduino/free', '~settings/arduino/rate',
        '~turn'}
    assert {name for name, each in found.items() if each.moves} == {'~speed', '~cmd_vel'}
    assert found['~calibrate_imu'].confirm and found['~arduino/reset'].confirm


def test_fields_have_the_limits_of_their_rows(found):
    assert limits(found['~gripper']) == [('x', 'number', -10, 10), ('z', 'number', 0, 3)]
    assert limits(found['~horn']) == [('data', 'bool', 0, 1)]
    assert limits(found['~tone']) == [('data', 'text', None, None)]
    assert limits(found['~path']) == [('data', 'array', -32768, 100)]
    assert limits(found['~turn']) == [('direction', 'number', 0, 1), ('distance', 'number', 0, 90)]
    assert limits(found['~settings/arduino/kp']) == [('value', 'number', 0, 10)]
    assert limits(found['~settings/arduino/free']) == [('value', 'number', None, None)]
    assert limits(found['~settings/arduino/rate']) == [('value', 'number', 0, 65535)]
    direction, distance = found['~lift'].fields
    assert dict(direction['choices']) == {'▲ up': 0, '▼ down': 1}
    assert (distance['low'], distance['high'], distance['unit'], distance['preset']) == \
        (1, 255, 'mm', 20)


def test_values_become_a_message_or_a_request(found):
    assert found['~gripper'].make({'x': -2.5, 'z': 3}).x == -2.5
    assert found['~tone'].make({'data': 'a\u00e4'}).data == 'a\u00e4'
    assert list(found['~path'].make({'data': [1, -2]}).data) == [1, -2]
    assert found['~cmd_vel'].make({'linear.x': 0.5, 'angular.z': -1}).angular.z == -1
    assert found['~lift'].make({'direction': 1, 'distance': 7}).distance == 7
    made = found['~settings/arduino/kp'].make({'value': 2})
    assert [each.value for each in made.config.doubles] == [2.0]
    assert found['~settings/arduino/kp'].service == '~settings/arduino/set_parameters'


@pytest.mark.parametrize('name, values, words', [
    ('~gripper', {'x': 1}, 'takes x, z'), ('~gripper', {'x': 1, 'z': 1, 'y': 1}, 'takes'),
    ('~gripper', {'x': 10.5, 'z': 1}, 'x is 10.5, out of range (-10 \u2026 10)'),
    ('~gripper', {'x': '1', 'z': 1}, ''), ('~gripper', {'x': {}, 'z': 1}, ''),
    ('~gripper', {'x': None, 'z': 1}, ''), ('~path', {'data': [1, 101]}, 'data is 101'),
    ('~path', {'data': ['a']}, ''), ('~path', {'data': 5}, ''), ('~lift', {'direction': 0}, ''),
    ('~tone', {'data': 'too long'}, ''), ('~tone', {'data': 5}, ''),
    ('~tone', {'data': 'a\0b'}, ''), ('~gripper', {'x': 10 ** 400, 'z': 1}, ''),
    ('~lift', {'direction': 0, 'distance': 300}, ''), ('~bus/echo', {'x': 1}, 'nothing'),
    ('~settings/arduino/kp', {'value': 11}, 'from 0 to 10 1/s'),
    ('~settings/arduino/kp', {'value': 'x'}, '')])
def test_values_that_do_not_fit_are_refused(found, name, values, words):
    with pytest.raises(CommandRefused) as refused:
        found[name].make(values)
    assert words in str(refused.value)
