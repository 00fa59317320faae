"""When the monitor says that a bridge has gone, or is back; without ROS."""
from serial_communication.tools.watch.live import Outages


def test_a_bridge_that_goes_and_comes_back():
    outages = Outages()
    assert outages.see('nothing yet', None, 0.0) == 'nothing yet'
    assert outages.see('nothing yet', None, 1.0) == ''
    assert outages.see('', 2.0, 2.0) == 'the bridge is there' and outages.notes() == ()
    assert outages.see('', 3.0, 3.0) == ''
    assert outages.see('silent', 3.0, 7.0) == 'silent'
    assert outages.see('no bridge', 3.0, 8.0) == ''      # one going is told once
    assert outages.see('', 63.0, 63.0) == 'the bridge is back, after 60 s'
    assert outages.notes()[0].text.endswith('the bridge is back, after 60 s')
    assert outages.see('', 64.0, 64.0) == '' and outages.notes()
    assert outages.see('silent', 64.0, 70.0) == 'silent' and outages.notes() == ()


def test_a_bridge_that_is_there_from_the_beginning():
    outages = Outages()
    assert outages.see('', 1.0, 1.0) == 'the bridge is there'
    assert outages.see('', 2.0, 2.0) == ''
