"""A bridge seen from outside: its topics, their text, its links and ages; without ROS."""
from types import SimpleNamespace as Message

import pytest
from serial_communication.boards import BOARDS, description
from serial_communication.tools.watch import topics
from serial_communication.tools.watch.state import BridgeState, LinkState, TopicState
from serial_communication.tools.watch.topics import BridgeTopic

NODE = '/serial_communication'


class Slots:
    """A message as genpy makes it: its fields are its slots."""

    def __init__(self, **fields):
        self.__slots__ = list(fields)
        self.__dict__.update(fields)


def words(type_, message):
    return BridgeTopic('any', type_).words(message)


def custom_topics(parameters):
    return [topic for name in BOARDS
            for topic in topics.row_topics(description(name), parameters)]


# -- names and what a bridge publishes ---------------------------------------------------------


@pytest.mark.parametrize('name, node, full', [
    ('~imu', NODE, '/serial_communication/imu'), ('mcu/status', NODE, '/mcu/status'),
    ('/tf', NODE, '/tf'), ('~imu', '/car/bridge', '/car/bridge/imu'),
    ('mcu/status', '/car/bridge', '/car/mcu/status'), ('/tf', '/car/bridge', '/tf'),
    ('/mcu/status', '/car/bridge', '/mcu/status'), ('serial_msg', '/a/b/c', '/a/b/serial_msg')])
def test_relative_and_absolute_names_convert_both_ways(name, node, full):
    assert topics.absolute(name, node) == full
    assert topics.relative(full, node) == name


def test_known_topics_are_listed_in_the_tables_order_before_others():
    found = topics.published_topics('/car/bridge', {
        '/car/bridge/settings/mcu/parameter_updates': 'dynamic_reconfigure/Config',
        '/car/zebra': 'nmea_msgs/Gpgga', '/tf': 'tf2_msgs/TFMessage',
        '/car/bridge/voltage': 'serial_communication/Voltage', '/rosout': 'rosgraph_msgs/Log',
        '/car/bridge/imu': 'sensor_msgs/Imu', '/car/air': 'sensor_msgs/Temperature'},
        {}, topics.boards_of({}))
    assert [each.name for each in found] == ['~imu', '~voltage', '/tf', 'air', 'zebra']
    assert found[0].links == ('arduino',) and found[3].links == ()


GAUGE = '''
from serial_communication.boards.description import Description, Topic
from serial_communication.framing.row_reader import Group
DESCRIPTION = Description(
    'gauge', __name__, lambda sent, parameters: None, 'rain gauge',
    topics=(Topic('rain', 'std_msgs/Float32', period_parameter='every'),
            Topic('rain/battery', 'std_msgs/Float32', 5.0)),
    groups=(Group('rows', 'rain/'),))
'''


def test_topics_of_a_board_of_another_package_are_known(tmp_path, monkeypatch):
    (tmp_path / 'rain_gauge').mkdir()
    (tmp_path / 'rain_gauge' / '__init__.py').write_text(GAUGE)
    monkeypatch.syspath_prepend(str(tmp_path))
    bridge = BridgeState()
    bridge.set_parameters({'boards': ['not_installed', 'rain_gauge', 3], 'gauge': {
        'port': '/dev/gauge', 'every': 60.0,
        'rows': {'snow': {'ros_type': 'std_msgs/Bool', 'period': 2.0}}}})
    assert bridge.board('gauge').title == 'rain gauge' and bridge.board('other') is None
    found = topics.published_topics(
        NODE, {'/rain/snow': 'std_msgs/Bool', '/rain': 'std_msgs/Float32',
               '/rain/battery': 'std_msgs/Float32', '/other': 'std_msgs/Bool'},
        bridge.parameters, bridge.boards)
    assert [(each.name, each.links, each.period) for each in found] == [
        ('other', (), None), ('rain', ('gauge',), 60.0), ('rain/battery', ('gauge',), 5.0),
        ('rain/snow', ('gauge',), 2.0)]
    assert topics.expected_links(bridge.parameters) == ['gauge']


def test_parameters_make_the_topics_of_custom_messages():
    parameters = {
        'arduino': {'port': '/dev/a', 'messages': {
            'force': {'type': 20, 'ros_type': 'std_msgs/Float32', 'layout': '<h',
                      'fields': ['data'], 'minimum': -5, 'maximum': 5.5},
            'pump': {'type': 21, 'ros_type': 'std_msgs/Float32', 'direction': 'to_board'}}},
        'mcu': {'port': '', 'messages': {'wind': {
            'type': 3, 'ros_type': 'geometry_msgs/Vector3Stamped', 'layout': '<hhhI',
            'fields': ['vector.x', '', 'vector.y', '@time']}}},
        'bus': {'port': '/dev/b', 'environment_period': 60.0, 'functions': {
            'grip': {'cmd2': 7, 'srv_type': 'std_srvs/Trigger'},
            'level': {'cmd2': 8, 'ros_type': 'std_msgs/UInt8', 'period': 5,
                      'reply': {'layout': '<B', 'fields': ['data']}}}}}
    custom = {each.name: each for each in custom_topics(parameters)}
    assert set(custom) == {'~force', 'mcu/wind', '~level'}
    assert custom['~force'].fields == ('data',)
    assert custom['mcu/wind'].fields == ('vector.x', 'vector.y')
    assert custom['~level'].period == 5.0 and custom['~level'].links == ('bus',)
    assert topics.expected_links(parameters) == ['bus', 'arduino']

    found = topics.published_topics(
        NODE, {NODE + '/force': 'std_msgs/Float32',
               NODE + '/environment': 'serial_communication/Environment'},
        parameters, topics.boards_of(parameters))
    assert found[0].period == 60.0
    value, = found[1].values(Message(data=1.5))
    assert value.value == 1.5
    wind = custom['mcu/wind']
    assert wind.words(Message(vector=Message(x=0.5, y=-1.25))) == 'vector.x 0.5, vector.y -1.25'


def test_announced_rows_make_topics_too_and_those_of_parameters_take_precedence():
    row = {'type': 20, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data']}
    custom = {each.name: each for each in custom_topics({'arduino': {
        'messages': {'force': row},
        'announced': {'force': dict(row, ros_type='std_msgs/Bool'), 'level': row}}})}
    assert {name: each.type for name, each in custom.items()} == {
        '~force': 'std_msgs/Float32', '~level': 'std_msgs/Float32'}


@pytest.mark.parametrize('parameters', [
    {}, {'arduino': 3}, {'arduino': {'announced': 5}},
    {'arduino': {'messages': 'x'}}, {'arduino': {'messages': {'x': 1}}},
    {'mcu': {'messages': {'x': {'ros_type': 'std_msgs/Bool', 'fields': [], 'minimum': [1]}}}},
    {'bus': {'functions': {'x': {'ros_type': 'std_msgs/Bool', 'reply': 3, 'period': 'y'}}}}])
def test_parameters_of_a_wrong_shape_are_ignored(parameters):
    custom_topics(parameters)
    assert topics.published_topics(NODE, {NODE + '/imu': 'sensor_msgs/Imu'}, parameters,
                                   topics.boards_of(parameters))[0].name == '~imu'
    assert topics.expected_links(parameters) == []


def test_links_of_other_packages_are_listed_last():
    assert topics.in_order(['gps', 'mcu', 'bus', 'air']) == ['bus', 'mcu', 'air', 'gps']


# -- words ---------------------------------------------------------------------------------------


def test_paths_that_a_message_does_not_have_are_left_out():
    topic = BridgeTopic('any', 'x/Y', fields=('position[2]', 'speed.z', 'name'))
    assert [value.text() for value in topic.values(Slots(position=[1, 2], name='n'))] == ['n']


# -- ages ----------------------------------------------------------------------------------------


def fed(topic, times):
    each = TopicState(topic)
    for time in times:
        each.received(time)
    return each


TENTHS = [tick / 10 for tick in range(100)] + [110.0]


@pytest.mark.parametrize('period, times, fresh_at, stale_at', [
    (1.0, [10.0], 12.9, 13.1),
    (None, range(0, 100, 10), 119.0, 121.0),                # the period is measured
    (None, [0.0], 1000.0, None),                            # one message gives no period
    (None, [0.0, 3600.0], 3779.0, 3781.0),                  # and a long pause not that one
    (None, [0.0, 3600.0, 3605.0, 3610.0], 3624.0, 3626.0),
    (None, [0.0, 3600.0, 3605.0, 3610.0, 3615.0], 3629.0, 3631.0),
    (0.01, [tick / 100 for tick in range(100)], 1.2, 1.4),  # 300 ms at least
    (None, TENTHS, 110.2, 110.5),                           # an outage hardly changes the period
    (None, TENTHS + [110.0 + each for each in range(1, 41)], 152.0, None)])     # a slower board
def test_a_value_is_stale_after_three_periods(period, times, fresh_at, stale_at):
    each = fed(BridgeTopic('any', 'x/Y', period=period), times)
    assert not each.stale(fresh_at) and (stale_at is None or each.stale(stale_at))
    assert TopicState(each.topic).age(10.0) is None and not TopicState(each.topic).stale(10.0)
    assert not fed(BridgeTopic('any', 'x/Y', period=period, ages=False), times).stale(1e4)


def test_the_rate_covers_the_last_few_seconds():
    each = TopicState(BridgeTopic('any', 'x/Y'))
    for second in range(10):
        each.measure(float(second))
        each.count += 100
    assert each.rate == pytest.approx(100.0)
    for second in range(10, 20):
        each.measure(float(second))
    assert each.rate == 0.0


# -- the bridge ----------------------------------------------------------------------------------


def reported(level, at, **values):
    return LinkState(level, 'open', values, at)


def test_links_are_those_reported_and_those_expected():
    bridge = BridgeState(links=['mcu'])
    bridge.set_link('gps', reported(0, 1.0))
    bridge.expect_links(['bus', 'mcu'])
    assert list(bridge.links) == ['bus', 'mcu', 'gps'] and bridge.links['bus'] is None
    assert bridge.links['gps'] is not None


def test_errors_are_counted_by_cause():
    link = LinkState(0, 'open', {'checksum errors': '3', 'framing errors': '4', 'port': 'x',
                                 'odd errors': 'many', 'square errors': '\u00b2',
                                 'arabic errors': '\u0663', 'endless errors': '9' * 5000})
    assert link.errors == {'checksum': 3, 'framing': 4}


def test_a_topic_keeps_its_state_while_its_type_is_the_same():
    bridge = BridgeState(topics=[BridgeTopic('~voltage', 'x/Y')])
    bridge.set_topics([BridgeTopic('~imu', 'sensor_msgs/Imu'), BridgeTopic('old', 'x/Y')])
    bridge.topic('~imu').received(1.0)
    bridge.set_topics([BridgeTopic('new', 'x/Y'), BridgeTopic('~imu', 'sensor_msgs/Imu')])
    # An expected topic stays, published or not.
    assert [each.topic.name for each in bridge.topics] == ['~imu', '~voltage', 'new']
    assert bridge.topic('~imu').count == 1
    bridge.set_topics([BridgeTopic('~imu', 'std_msgs/Bool')])
    assert bridge.topic('~imu').count == 0


def test_all_ok_requires_every_link_and_no_trouble():
    bridge = BridgeState()
    bridge.master_answered(True, 5.0)
    assert not bridge.all_ok(5.0)
    bridge.set_link('bus', reported(0, 5.0))
    assert bridge.all_ok(5.0)
    bridge.set_link('mcu', reported(1, 5.0))
    assert not bridge.all_ok(5.0)
    bridge.set_link('mcu', reported(0, 5.0))
    bridge.expect_links(['gps'])
    assert not bridge.all_ok(5.0)     # no status of it yet
    bridge.set_link('gps', reported(0, 1.0))
    assert not bridge.all_ok(5.0)     # reported too long ago
