"""Read by catkin_python_setup() alone; build with catkin."""
from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

setup(**generate_distutils_setup(
    packages=['serial_communication'] + ['serial_communication.' + name for name in (
        'protocols', 'links', 'ros', 'simulation', 'tools', 'tools.bench', 'tools.soak')],
    package_dir={'': '.'}))
