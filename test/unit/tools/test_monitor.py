"""The monitor: reports of a bridge that disappears or returns, and the list of others; no ROS."""

from serial_communication.tools.monitor import report
from serial_communication.tools.watch.live import Outages
from serial_communication.tools.watch.state import BridgeState, ERROR, LinkState


def test_a_bridge_that_disappears_and_returns_is_reported_once_each():
    outages = Outages()
    assert outages.update('nothing yet', None, 0.0) == 'nothing yet'
    assert outages.update('nothing yet', None, 1.0) == ''
    assert outages.update('', 2.0, 2.0) == 'the bridge is there' and outages.notes() == ()
    assert outages.update('', 3.0, 3.0) == ''
    assert outages.update('silent', 3.0, 7.0) == 'silent'
    assert outages.update('no bridge', 3.0, 8.0) == ''      # an outage is reported once
    assert outages.update('', 63.0, 63.0) == 'the bridge is back, after 60 s'
    assert outages.notes()[0].text.endswith('the bridge is back, after 60 s')
    assert outages.update('', 64.0, 64.0) == '' and outages.notes()
    assert outages.update('silent', 64.0, 70.0) == 'silent' and outages.notes() == ()


def test_a_report_has_the_diagnostics_and_parameters_but_no_secret_and_no_host():
    bridge = BridgeState(links=['bus', 'arduino'])
    bridge.set_link('bus', LinkState(ERROR, 'socket://robot.lan:4001: no connection',
                                     {'checksum errors': '3'}))
    bridge.set_parameters({'bus': {'port': 'rfc2217://me:hunt/er2@192.168.1.7:4001?logging=info',
                                   'reply_timeout': 0.5},
                           'scale': {'MQTT_Password': 'hunter3', 'access_token': [1, 'hunter4']}})
    text = report.of_bridge(bridge)
    assert '  bus  ERROR  socket://…: no connection\n    checksum errors: 3\n' in text
    assert '  arduino  no report\n' in text and '    reply_timeout: 0.5\n' in text
    assert '    port: rfc2217://…?logging=info\n' in text
    assert '    MQTT_Password: …\n' in text and text.endswith('    access_token: …')
    assert not any(word in text for word in ('hunt', '192.168', 'robot.lan'))
