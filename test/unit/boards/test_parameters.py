"""The parameters of the node and the boards: config/bridge.yaml, which documents them, and what is
refused in one line. Needs ROS, but no master."""
from math import pi, radians
from pathlib import Path

import pytest
import yaml

pytest.importorskip('rospy')
from serial_communication.boards import descriptions  # noqa: E402
from serial_communication.framing.rows import RowError  # noqa: E402
from serial_communication.ros.parameters import (  # noqa: E402
    NODE_PARAMETERS, NameTaken, check, parameters_of, resolved_names)

PARAMETERS = {**NODE_PARAMETERS, **{
    f'{board.name}/{name}': parameter for board in descriptions()
    for name, parameter in parameters_of(board.binder).items()}}
GIVEN = yaml.safe_load((Path(__file__).parents[3] / 'config' / 'bridge.yaml').read_text())
DEFAULTS = {
    'bus/environment_period': 1.0, 'bus/environment_datelen': 2, 'bus/reply_has_cmd2': False,
    'bus/echo': True, 'bus/announcements': False, 'bus/reply_timeout': 0.5,
    'bus/motion_timeout': 5.0, 'bus/retries': 2, 'bus/baud': 115200, 'bus/reset_line': '',
    'arduino/baud': 115200, 'arduino/heartbeat_rate': 100.0, 'arduino/speed_timeout': 0.5,
    'arduino/command_age': 0.5, 'arduino/network_silence': 1.5,
    'arduino/check_plausibility': True, 'arduino/announcements': True, 'arduino/board_time': True,
    'arduino/gyro_scale': 4000 / 65536 * pi / 180 * 25, 'arduino/reset_line': 'dtr',
    'arduino/linear_acceleration_stdev': 400e-6 * 9.807,
    'arduino/angular_velocity_stdev': radians(0.05), 'arduino/roll_pitch_stdev': radians(1),
    'arduino/yaw_stdev': radians(5), 'mcu/baud': 115200, 'mcu/timeout': 1.0,
    'mcu/network_silence': 5.0, 'mcu/yaw_clockwise': True, 'mcu/announcements': True,
    'mcu/board_time': True, 'mcu/reset_line': 'rts', 'frame_timeout': 0.05, 'publish_tf': False,
    'frame_prefix': '', 'boards': [], 'base_frame_id': 'base_link'}
FORCE = {'type': 32, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data']}
PUMP = {'cmd2': 0x30, 'srv_type': 'std_srvs/SetBool'}
COVARIANCE = {'ros_type': 'sensor_msgs/Imu', 'fields': ['orientation_covariance']}
BATTERY = dict(FORCE, ros_type='sensor_msgs/BatteryState', fields=['voltage'])


def flatten(tree, prefix=''):
    """Nested groups as one dict, whose names have slashes."""
    flat = {}
    for name, value in tree.items():
        flat.update(flatten(value, f'{prefix}{name}/') if isinstance(value, dict) and value
                    else {prefix + name: value})
    return flat


def given(name, value):
    """The tree with one parameter."""
    for part in reversed(name.split('/')):
        value = {part: value}
    return value


def refusal(tree):
    """The line that says why a parameter is refused."""
    with pytest.raises(RowError) as caught:
        check(tree)
    text = str(caught.value)
    assert '\n' not in text
    return text


def test_the_file_has_every_parameter_with_its_default_except_for_the_ports():
    flat = flatten(GIVEN)
    assert set(flat) == set(PARAMETERS)
    for name, value in flat.items():
        default = PARAMETERS[name].default
        if name.endswith('/port'):
            assert default == '' and value.startswith('/dev/')
        else:
            assert value == (pytest.approx(default) if isinstance(default, float) else default)
            assert isinstance(value, bool) == isinstance(default, bool)
    _node, boards, unknown = check(GIVEN)
    assert not unknown and [values['port'] for values in boards.values()] == [
        GIVEN[link]['port'] for link in ('bus', 'arduino', 'mcu')]


def test_the_defaults_are_those_of_the_contract():
    assert {name: PARAMETERS[name].default for name in DEFAULTS} == pytest.approx(DEFAULTS)


@pytest.mark.parametrize('name', PARAMETERS)
def test_every_parameter_refuses_the_wrong_type_and_values_outside_its_range(name):
    parameter = PARAMETERS[name]
    wrong = {'a': {}} if isinstance(parameter.default, list) else [1]
    text = refusal(given(name, wrong))
    assert f'{name} is {wrong!r}' in text and 'may be ' in text
    if type(parameter.default) in (int, float) and not parameter.choices:
        step = type(parameter.default)(1)
        for value in parameter.low - step, parameter.high + step:
            refusal(given(name, type(parameter.default)(value)))


def test_a_whole_number_is_accepted_for_a_float_and_an_unknown_name_is_warned_of():
    _node, boards, unknown = check({'bus': {'reply_timeout': 2, 'replytimeout': 1}})
    assert repr(next(iter(boards.values()))['reply_timeout']) == '2.0'
    assert unknown == ['bus/replytimeout']


def test_two_links_with_the_same_port_are_refused(tmp_path):
    link = tmp_path / 'by-id'
    link.symlink_to('/dev/null')
    for one, other in (('/dev/null', '/dev/null'), ('/dev/null', str(link)),
                       ('socket://a:1', 'SOCKET://A:1')):
        text = refusal({'bus': {'port': one}, 'mcu': {'port': other, 'baud': 9600}})
        assert f'mcu/port is {other!r}' in text and 'bus' in text
    loop = {'port': 'loop://'}
    check({'bus': loop, 'mcu': loop, 'arduino': {'port': ''}})


def test_a_board_of_another_package_has_parameters_and_what_its_import_raises_passes(
        tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, code in (('fails', '1 / 0'), ('wind_board', BOARD)):
        (tmp_path / name).mkdir()
        (tmp_path / name / '__init__.py').write_text(DESCRIPTION)
        (tmp_path / name / 'ros.py').write_text(code)
    with pytest.raises(ZeroDivisionError):
        check({'boards': ['fails']})
    with pytest.raises(ImportError):
        check({'boards': ['no.such']})
    for boards in ['x', 5], {'a': 'b'}, 'x', [['x']]:
        assert 'may be a list' in refusal({'boards': boards})
    _node, boards, unknown = check({'boards': ['wind_board'], 'wind': {'baud': 9600, 'own': 1}})
    binder, values = boards.popitem()
    assert (binder.BOARD.name, values['baud'], unknown) == ('wind', 9600, ['wind/own'])


DESCRIPTION = """
from serial_communication.boards.description import Description
DESCRIPTION = Description('wind', __name__, None)
"""
BOARD = """
from serial_communication.ros.binder import Binder
from . import DESCRIPTION


class BoardBinder(Binder):
    BOARD = DESCRIPTION
"""


# -- mistakes in rows that only ROS reveals ------------------------------------------------------


@pytest.mark.parametrize('changes, key', [
    ({'ros_type': 'std_msgs/Flot32'}, 'ros_type'), ({'ros_type': 'std_msg/Float32'}, 'ros_type'),
    # Modules and classes that are not messages.
    ({'ros_type': 'rospy/struct'}, 'ros_type'), ({'ros_type': 'rospy/AnyMsg'}, 'ros_type'),
    ({'ros_type': 'os/path'}, 'ros_type'), ({'fields': ['dta']}, 'fields'),
    ({'fields': ['data.x']}, 'fields'), ({'fields': ['data[0]']}, 'fields'),
    ({'layout': '<s'}, 'fields'), ({'layout': '<h*'}, 'fields'), ({'frame_id': 'x'}, 'frame_id'),
    ({'layout': '<I', 'fields': ['@time']}, 'fields'),
    ({'ros_type': 'std_msgs/String'}, 'fields'),
    ({'ros_type': 'std_msgs/Header', 'fields': ['stamp']}, 'fields'), (COVARIANCE, 'fields'),
    (dict(COVARIANCE, layout='<h*'), 'fields'),
    (dict(COVARIANCE, fields=['orientation_covariance[9]']), 'fields'),
    (dict(COVARIANCE, fields=['orientation.q']), 'fields'), ({'scale': 0}, 'scale'),
    *((dict(BATTERY, constants=constants), 'constants' + key) for constants, key in (
        ({'presnt': True}, ''), ({'charge': 'full'}, '/charge'), ({'charge': 1e39}, '/charge'),
        ({'power_supply_status': 256}, '/power_supply_status'),
        ({'power_supply_status': 0.5}, '/power_supply_status'), ({'location': 5}, '/location'),
        ({'cell_voltage': 3.7}, '/cell_voltage'), ({'header.stamp': 0}, '/header.stamp'),
        ({'orientation.yaw': 1.0}, '')))])
def test_a_mistake_in_a_message_is_named(changes, key):
    text = refusal({'arduino': {'messages': {'force': {**FORCE, **changes}}}})
    assert text.startswith(f'arduino/messages/force/{key} is ')


@pytest.mark.parametrize('changes, key', [
    ({'srv_type': 'std_srvs/SetBoolRequest'}, 'srv_type'),
    ({'srv_type': 'std_srv/SetBool'}, 'srv_type'), ({'srv_type': 'std_srvs/SetBol'}, 'srv_type'),
    ({'request': {'layout': '<?', 'fields': ['dat']}}, 'request/fields'),
    ({'reply': {'layout': '<?', 'fields': ['success'], 'invalid': 1}}, 'reply/invalid'),
    ({'reply': {'layout': '<?', 'fields': ['data']}}, 'reply/fields')])
def test_a_mistake_in_a_function_is_named(changes, key):
    text = refusal({'bus': {'functions': {'pump': {**PUMP, **changes}}}})
    assert text.startswith(f'bus/functions/pump/{key} is ')


def test_constants_that_the_type_can_hold_are_taken():
    check({'arduino': {'messages': {'pack': dict(BATTERY, constants={
        'charge': float('nan'), 'cell_voltage[1]': 4, 'power_supply_status': 255})}}})


def test_names_that_are_taken_are_refused():
    def clash(tree):
        tree = {board: {'port': f'/dev/{board}', **tree.get(board, {})}
                for board in ('bus', 'arduino', 'mcu')}
        resolved_names(check(tree)[1])
    for name, tree in (('voltage', {'arduino': {'messages': {'voltage': FORCE}}}),
                       ('lift', {'arduino': {'messages': {'lift': FORCE}}}),
                       ('range_1', {'mcu': {'messages': {'range_1': FORCE}}}),
                       ('gimbal', {'bus': {'functions': {'gimbal': PUMP}}}),
                       ('both', {'arduino': {'messages': {'both': FORCE}},
                                 'bus': {'functions': {'both': PUMP}}})):
        with pytest.raises(NameTaken, match=f'/{name} is the name of .* and of '):
            clash(tree)
    # These differ: mcu/imu is not ~imu, and a topic may have the name of a parameter.
    clash({'arduino': {'messages': {'status': FORCE, 'port': dict(FORCE, type=33)}},
           'mcu': {'messages': {'voltage': FORCE}}})
