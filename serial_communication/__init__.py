"""The bridge between a ROS 1 robot and its boards on serial lines.

CONTRIBUTING.md lists its layers, and which of them each may import.
"""
from pkgutil import extend_path

# The generated messages stand in another folder under the same package name.
__path__ = extend_path(__path__, __name__)
