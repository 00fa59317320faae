"""Imports run one way, and only ros and tools know ROS:

    tools -> ros -> links -> transport, protocols <- simulation

The list of boards (boards.py) imports nothing: it finds modules by name when it is asked. What
programs do first (output.py) imports nothing of this package either."""
import ast
from pathlib import Path
from typing import Iterator

import pytest
from sources import PACKAGE, name

# What each folder may import of this package, itself aside.
ALLOWED = {
    'protocols': (),
    'transport': (),
    'links': ('protocols', 'transport'),
    'simulation': ('boards', 'output', 'protocols', 'transport'),
    'ros': ('boards', 'links', 'output', 'protocols', 'transport', 'msg', 'srv'),
    'tools': ('boards', 'ros', 'links', 'output', 'protocols', 'simulation', 'transport', 'msg',
              'srv'),
}
KNOWS_ROS = ('ros', 'tools')


def imports(path: Path) -> Iterator[str]:
    """Each imported module by its full name; imports inside functions, too."""
    package = ['serial_communication', *path.relative_to(PACKAGE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) - node.level + 1] if node.level else []
            base = base + (node.module.split('.') if node.module else [])
            for alias in node.names:    # a module or a name in one: the longer is as good
                yield '.'.join(base + [alias.name])


def is_ros(module: str) -> bool:
    """Whether a module belongs to ROS."""
    top = module.split('.')[0]
    return (top in ('rospy', 'roslib', 'rospkg', 'rosgraph', 'roslaunch', 'rosbag', 'tf',
                    'tf2_ros', 'genpy', 'diagnostic_updater')
            or top.endswith(('_msgs', '_srvs')))


@pytest.mark.parametrize('path', sorted(PACKAGE.rglob('*.py')), ids=name)
def test_imports(path):
    parts = path.relative_to(PACKAGE).parts
    if len(parts) == 1:
        return
    folder = parts[0]
    for module in imports(path):
        if folder not in KNOWS_ROS:
            assert not is_ros(module), '%s imports %s' % (name(path), module)
        if module.startswith('serial_communication.'):
            inner = module.split('.', 1)[1]
            assert any((inner + '.').startswith(allowed + '.')
                       for allowed in (folder,) + ALLOWED[folder]), '%s imports %s' % (
                           name(path), module)


def test_every_folder_has_a_rule():
    folders = {path.parent.name for path in PACKAGE.glob('*/__init__.py')}
    assert folders == set(ALLOWED)


def test_the_rule_can_fail():
    assert is_ros('rospy') and is_ros('sensor_msgs.msg.Imu') and not is_ros('serial.tools')
    found = set(imports(PACKAGE / 'ros' / 'node.py'))
    assert 'rospy' in found
    assert 'serial_communication.ros.interface.Common' in found
