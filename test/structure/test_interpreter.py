"""Programs run with ROS's Python, whichever python3 is first on the PATH.

Debian's rosrun runs the files of a checkout directly. Another Python (of pyenv, conda or a virtual
environment) has neither rospy nor pyserial.
"""
import os

from sources import ROOT, name, python_programs


def test_the_first_line_names_the_systems_python():
    tests = [path for path in sorted((ROOT / 'test').rglob('*.py')) if os.access(path, os.X_OK)]
    programs = python_programs() + tests
    assert [name(path) for path in programs
            if path.read_text().split('\n', 1)[0] != '#!/usr/bin/python3'] == []
    assert {'serial_communication_node', 'simulator', 'monitor', 'contract_test.py'} <= {
        path.name for path in programs}
