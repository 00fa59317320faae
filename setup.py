"""Read by catkin_python_setup() alone; build with catkin."""
from setuptools import setup
from catkin_pkg.python_setup import generate_distutils_setup

setup(**generate_distutils_setup(
    packages=['serial_communication'] + ['serial_communication.' + name for name in (
        'protocols', 'links', 'ros', 'simulation', 'tools')],
    package_dir={'': '.'}))
