"""One roscore for all tests of the panel, and the boards of the ROS tests at the lines' ends."""
import os
import sys
import tempfile
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'ros'))
pytest.register_assert_rewrite('panel_stage')

from panel_stage import TOKEN, Core, Panel, Robot, free_port  # noqa: E402


@pytest.fixture(scope='session')
def core():
    """A roscore, which a test may end and start again; this process is a node of it."""
    os.environ['ROS_MASTER_URI'] = f'http://localhost:{free_port()}'
    os.environ['ROS_HOSTNAME'] = 'localhost'
    core = Core()
    import rospy
    rospy.init_node('panel_test', disable_signals=True)
    yield core
    rospy.signal_shutdown('the tests are over')
    core.stop()


@pytest.fixture(scope='module')
def robot(core):
    """A bridge with three boards that do what the test says, on lines that can be cut."""
    with tempfile.TemporaryDirectory(prefix='panel_') as folder:
        robot = Robot(folder)
        yield robot
        robot.end()


@pytest.fixture(scope='module')
def panel(robot):
    """One that only looks."""
    panel = Panel(name='panel_looks')
    yield panel
    assert panel.end() == 0
    assert 'Traceback' not in panel.output()


@pytest.fixture(scope='module')
def controls(robot):
    """One that takes commands."""
    panel = Panel('--control', '--token', TOKEN, name='panel_control')
    yield panel
    assert panel.end() == 0
    assert 'Traceback' not in panel.output()
