"""One roscore and one robot for all tests of the panel."""
import os
import sys
import tempfile
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'ros'))
pytest.register_assert_rewrite('panel_helpers')

from panel_helpers import TOKEN, Core, Panel, Robot, free_port  # noqa: E402


@pytest.fixture(scope='session')
def core():
    """A roscore, which a test may restart; this process is a node."""
    os.environ['ROS_MASTER_URI'] = f'http://localhost:{free_port()}'
    os.environ['ROS_HOSTNAME'] = 'localhost'
    core = Core()
    import rospy
    rospy.init_node('panel_test', disable_signals=True)
    yield core
    rospy.signal_shutdown('the tests are over')
    core.stop()


@pytest.fixture(scope='session')
def started_robot(core):
    """The robot in the state of the last test; for `robot` and the panels."""
    with tempfile.TemporaryDirectory(prefix='panel_') as folder:
        robot = Robot(folder)
        yield robot
        robot.end()


@pytest.fixture(scope='module')
def robot(started_robot):
    """A bridge with three boards that a test controls, on lines that can be unplugged."""
    started_robot.reset()
    return started_robot


@pytest.fixture(scope='session')
def panel(started_robot):
    """A panel that is read-only."""
    with Panel(name='panel_read_only') as panel:
        yield panel


@pytest.fixture(scope='session')
def control_panel(started_robot, tmp_path_factory):
    """A panel that takes commands, whose token is in a file."""
    file = tmp_path_factory.mktemp('token') / 'token'
    file.write_text(TOKEN + '\n')
    with Panel('--control', '--token', f'@{file}', name='panel_control') as panel:
        yield panel
