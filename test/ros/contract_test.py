#!/usr/bin/python3
"""The contract of the bridge with ROS, by one bridge with three simulated boards behind socat
pairs, and one of another package. The order of the cases is that of doc/interface.md."""
import unittest

import rospy
import rostest

from boards import PACKAGE
from contract_commands import Age, Commands, Services, Stop
from contract_links import Diagnostics, End, Lending, Programs, Traffic
from contract_published import BoardTime, Names, Published, Transforms
from contract_robot import robot
from contract_rows import Announced, OwnFunctions, OwnMessages, Settings


def load_tests(loader, _tests, _pattern):
    """The cases, in this order."""
    return unittest.TestSuite(map(loader.loadTestsFromTestCase, (
        Names, Published, Transforms, BoardTime, Traffic, Diagnostics, Commands, Age, Services,
        Stop, OwnMessages, OwnFunctions, Announced, Settings, Lending, Programs, End)))


if __name__ == '__main__':
    rospy.init_node('contract_test')
    robot()
    rostest.rosrun(PACKAGE, 'contract', '__main__')
