"""One ROS master, robot and panel for the tests in a browser."""
import os
import sys
import tempfile
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'ros'))
pytest.register_assert_rewrite('robot')
os.environ['ASYNC_TEST_TIMEOUT'] = '60'      # s that tornado's tests may take, on a busy machine


@pytest.fixture(scope='session')
def core():
    """A ROS master; this process is a node."""
    from robot import Core
    core = Core().start()
    import rospy
    rospy.init_node('panel_test', disable_signals=True)
    yield core
    rospy.signal_shutdown('the tests are over')
    core.end()


@pytest.fixture(scope='session')
def robot(core):
    """A bridge with three boards that a test controls."""
    from robot import Robot
    with tempfile.TemporaryDirectory(prefix='panel_') as folder:
        robot = Robot(folder)
        yield robot
        robot.end()


@pytest.fixture(scope='session')
def panel(robot):
    """A panel that takes commands."""
    from robot import Panel
    with Panel('--control') as panel:
        yield panel


@pytest.fixture(scope='session')
def chromium():
    """A browser."""
    if not os.path.exists('/usr/bin/chromedriver'):
        pytest.skip('no browser: Ubuntu has chromium only as a snap, which no driver can start')
    from panel_browser import Browser
    browser = Browser()
    yield browser
    browser.quit()


@pytest.fixture
def page(chromium, panel, robot):
    """The page of the panel; at the end, its console must have no error."""
    chromium.open('about:blank')     # or only the part after # changes, and nothing is loaded
    chromium.open(panel.url)
    chromium.wait_for_text('#connection', 'live')
    chromium.wait(lambda page: page.attribute('#stop', 'aria-pressed') == 'false', 'it may move')
    robot.car.forget()
    yield chromium
    chromium.script('window.dispatchEvent(new Event("blur"))')
    assert chromium.errors() == []
