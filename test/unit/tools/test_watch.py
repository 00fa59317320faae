"""A bridge seen from outside: its topics, their text, its links and ages; without ROS."""
from types import SimpleNamespace as Message

import pytest
from serial_communication.boards import BOARDS, description
from serial_communication.srv import LiftResponse
from serial_communication.tools.watch import topics
from serial_communication.tools.watch.calls import Verdict, read_response
from serial_communication.tools.watch.state import BridgeState, LinkState, TopicState
from serial_communication.tools.watch.topics import BridgeTopic

NODE = '/serial_communication'


def words(type_, message):
    return BridgeTopic('any', type_).words(message)


def custom_topics(parameters):
    return [topic for name in BOARDS
            for topic in topics.row_topics(description(name), parameters)]


@pytest.mark.parametrize('status, verdict', [
    (LiftResponse.NOT_SENT, Verdict.REFUSED), (3, Verdict.REFUSED), (255, Verdict.REFUSED),
    (LiftResponse.TIMEOUT, Verdict.NOT_KNOWN), (2, Verdict.NOT_KNOWN), (77, Verdict.NOT_KNOWN)])
def test_only_a_call_that_was_certainly_not_executed_counts_as_refused(status, verdict):
    assert read_response(LiftResponse(False, status, 0, 'why')) == (verdict, 'why')


# -- names and what a bridge publishes ---------------------------------------------------------


@pytest.mark.parametrize('name, node, full', [
    ('~imu', NODE, '/serial_communication/imu'), ('mcu/status', NODE, '/mcu/status'),
    ('/tf', NODE, '/tf'), ('~imu', '/car/bridge', '/car/bridge/imu'),
    ('mcu/status', '/car/bridge', '/car/mcu/status'), ('/tf', '/car/bridge', '/tf'),
    ('/mcu/status', '/car/bridge', '/mcu/status'), ('serial_msg', '/a/b/c', '/a/b/serial_msg')])
def test_relative_and_absolute_names_convert_both_ways(name, node, full):
    assert topics.absolute(name, node) == full
    assert topics.relative(full, node) == name


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


# -- words ---------------------------------------------------------------------------------------


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


# -- the bridge ----------------------------------------------------------------------------------


def reported(level, at, **values):
    return LinkState(level, 'open', values, at)


def test_errors_are_counted_by_cause():
    link = LinkState(0, 'open', {'checksum errors': '3', 'framing errors': '4', 'port': 'x',
                                 'odd errors': 'many', 'square errors': '\u00b2',
                                 'arabic errors': '\u0663', 'endless errors': '9' * 5000})
    assert link.errors == {'checksum': 3, 'framing': 4}


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
