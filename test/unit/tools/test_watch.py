"""A bridge seen from outside: topics and their text, links, ages, and the table; without ROS."""
from types import SimpleNamespace as Message

import pytest

from serial_communication.boards import BOARDS, description
from serial_communication.msg import McuStatus2
from serial_communication.srv import LiftResponse
from serial_communication.tools.monitor import report
from serial_communication.tools.watch import table, topics
from serial_communication.tools.watch.calls import Verdict, read_response
from serial_communication.tools.watch.state import (ERROR, OK, WARN, BridgeState, LinkState,
                                                    TopicState)
from serial_communication.tools.watch.topics import BridgeTopic

NODE = '/serial_communication'
NOW = 4000.0


@pytest.mark.parametrize('status, verdict', [
    (LiftResponse.NOT_SENT, Verdict.REFUSED), (3, Verdict.REFUSED), (255, Verdict.REFUSED),
    (LiftResponse.TIMEOUT, Verdict.NOT_KNOWN), (2, Verdict.NOT_KNOWN), (77, Verdict.NOT_KNOWN)])
def test_only_a_call_that_was_certainly_not_executed_counts_as_refused(status, verdict):
    assert read_response(LiftResponse(False, status, 0, 'why')) == (verdict, 'why')


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
    custom = {topic.name: topic for name in BOARDS
              for topic in topics.row_topics(description(name), parameters)}
    assert {name: (each.fields, each.links, each.period) for name, each in custom.items()} == {
        '~force': (('data',), ('arduino',), None),
        'mcu/wind': (('vector.x', 'vector.y'), ('mcu',), None),
        '~level': (('data',), ('bus',), 5.0)}
    assert topics.expected_links(parameters) == ['bus', 'arduino']
    environment, force = topics.published_topics(
        NODE, {NODE + '/force': 'std_msgs/Float32',
               NODE + '/environment': 'serial_communication/Environment'},
        parameters, topics.boards_of(parameters))
    assert environment.period == 60.0
    assert [each.value for each in force.values(Message(data=1.5))] == [1.5]
    assert custom['mcu/wind'].words(
        Message(vector=Message(x=0.5, y=-1.25))) == 'vector.x 0.5, vector.y -1.25'


def test_a_status_of_the_sensor_board_has_units_and_no_value_of_a_range_that_timed_out():
    status = McuStatus2(vl53_1=65535, vl53_2=420, yaw=12.34)
    assert BridgeTopic('mcu/status', status._type).words(status) == (
        'valid no, last_frame_age_sec 0.00 s, vl53_1 no value, vl53_2 420 mm, yaw 12.3 deg, '
        'pitch 0.0 deg, roll 0.0 deg')


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
    assert not TopicState(each.topic).stale(10.0)
    assert not fed(BridgeTopic('any', 'x/Y', period=period, ages=False), times).stale(1e4)


# -- the bridge ----------------------------------------------------------------------------------


def bridge(registered=True, **links):
    """A bridge whose links have these levels, and that has two topics."""
    made = BridgeState(NODE, 'http://here')
    made.master_answered(registered, NOW)
    made.set_topics([BridgeTopic('~voltage', 'x/Y', period=1.0), BridgeTopic('~led', 'x/Y')])
    for name, level in links.items():
        made.set_link(name, LinkState(level, 'open', {
            'checksum errors': '3', 'framing errors': '4', 'timeouts': '2', 'reconnects': '0',
            'odd errors': 'many', 'square errors': '\u00b2', 'endless errors': '9' * 5000}, NOW))
    return made


@pytest.mark.parametrize('links, later, is_ok, trouble', [
    ({}, 0, False, 'has reported nothing yet'), ({'bus': OK}, 0, True, ''),
    ({'bus': OK, 'mcu': WARN}, 0, False, ''), ({'bus': OK, 'mcu': OK}, 2.9, True, ''),
    ({'bus': OK}, 3.1, False, 'no answer from the ROS master at http://here')])
def test_all_is_ok_if_every_link_is_and_reports(links, later, is_ok, trouble):
    watched = bridge(**links)
    assert watched.all_ok(NOW + later) == is_ok
    assert (trouble in watched.trouble(NOW + later)) and bool(trouble) == bool(
        watched.trouble(NOW + later))
    assert bridge(registered=False).trouble(NOW).startswith(f'no bridge {NODE}')


def test_the_table_has_links_errors_by_cause_values_and_ages():
    watched = bridge(mcu=OK, bus=ERROR)
    each = watched.topic('~voltage')
    each.received(NOW)
    each.words, each.rate = '11.5 V', 1.0
    found = {line.text.split()[0]: line for line in table.lines(watched, NOW)}
    assert [*found] == ['Bridge', 'bus', 'mcu', '~voltage', '~led']
    assert (found['bus'].level, found['mcu'].level) == (ERROR, OK)
    assert found['mcu'].text.endswith('open, errors 7 (3 checksum, 4 framing), timeouts 2')
    assert found['~voltage'].text.split() == ['~voltage', '1.0', 'Hz', '11.5', 'V']
    later = {line.text.split()[0]: line for line in table.lines(watched, NOW + 3.5)}
    assert later['~voltage'].text.split() == ['~voltage', '3.5', 's', 'old', '11.5', 'V']
    assert 'STALE' in later['mcu'].text


def test_a_report_has_the_diagnostics_and_parameters_but_no_secret_and_no_host():
    watched = BridgeState()
    watched.expect_links(['bus', 'arduino'])
    watched.set_link('bus', LinkState(ERROR, 'socket://robot.lan:4001: no connection',
                                      {'checksum errors': '3'}))
    watched.set_parameters({'bus': {'port': 'rfc2217://me:hunt/er2@192.168.1.7:4001?logging=info',
                                    'reply_timeout': 0.5},
                            'scale': {'MQTT_Password': 'hunter3', 'access_token': [1, 'hunter4']}})
    text = report.of_bridge(watched)
    assert '  bus  ERROR  socket://…: no connection\n    checksum errors: 3\n' in text
    assert '  arduino  no report\n' in text and '    reply_timeout: 0.5\n' in text
    assert '    port: rfc2217://…?logging=info\n' in text
    assert '    MQTT_Password: …\n' in text and text.endswith('    access_token: …')
    assert not any(word in text for word in ('hunt', '192.168', 'robot.lan'))
