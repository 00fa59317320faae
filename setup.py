"""Read by catkin_python_setup() alone; build with catkin."""
from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

FOLDERS = ('transport', 'framing', 'link', 'simulation', 'ros', 'ros.rospy_mends',
           'boards', 'boards.arduino', 'boards.bus', 'boards.mcu',
           'tools', 'tools.demo', 'tools.monitor', 'tools.panel', 'tools.watch', 'tools.wire')

setup(**generate_distutils_setup(
    packages=['serial_communication'] + ['serial_communication.' + name for name in FOLDERS],
    package_dir={'': '.'},
    package_data={'serial_communication.tools.panel': ['web/*.*', 'web/cards/*.*']}))
