"""Only for catkin_python_setup(); build with catkin."""
from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import find_packages, setup

setup(**generate_distutils_setup(
    packages=find_packages(include=['serial_communication', 'serial_communication.*']),
    package_dir={'': '.'},
    package_data={'serial_communication.tools.panel': [
        'web/*.*', 'web/cards/*.*', 'web/vendor/*']}))
