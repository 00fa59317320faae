"""The bridge between a ROS 1 robot and its boards on serial lines.

Imports run one way: ``ros`` -> ``links`` -> ``protocols`` and ``transport`` <- ``simulation``.
Only ``ros`` and ``tools`` know rospy.
"""
from pkgutil import extend_path

# The generated messages stand in another folder under the same package name.
__path__ = extend_path(__path__, __name__)
