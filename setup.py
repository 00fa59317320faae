"""Read by catkin_python_setup() alone; build with catkin."""
from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

FOLDERS = ('protocols', 'transport', 'links', 'ros', 'simulation',
           'tools', 'tools.bench', 'tools.demo', 'tools.monitor', 'tools.panel', 'tools.soak',
           'tools.watch', 'tools.wire')

setup(**generate_distutils_setup(
    packages=['serial_communication'] + ['serial_communication.' + name for name in FOLDERS],
    package_dir={'': '.'},
    package_data={'serial_communication.tools.panel': ['web/*.*', 'web/cards/*.*']}))
