"""When the monitor says that a bridge has gone, or is back; without ROS."""
from serial_communication.tools.monitor.cli import Presence


def test_a_bridge_that_goes_and_comes_back():
    presence = Presence()
    assert presence.see('nothing yet', None, 0.0) == 'nothing yet'
    assert presence.see('nothing yet', None, 1.0) == ''
    assert presence.see('', 2.0, 2.0) == 'the bridge is there' and presence.notes() == []
    assert presence.see('', 3.0, 3.0) == ''
    assert presence.see('silent', 3.0, 7.0) == 'silent'
    assert presence.see('no bridge', 3.0, 8.0) == ''      # one going is told once
    assert presence.see('', 63.0, 63.0) == 'the bridge is back, after 60 s'
    assert presence.notes()[0].text.endswith('the bridge is back, after 60 s')
    assert presence.see('', 64.0, 64.0) == '' and presence.notes()
    assert presence.see('silent', 64.0, 70.0) == 'silent' and presence.notes() == []


def test_a_bridge_that_is_there_from_the_beginning():
    presence = Presence()
    assert presence.see('', 1.0, 1.0) == 'the bridge is there'
    assert presence.see('', 2.0, 2.0) == ''
