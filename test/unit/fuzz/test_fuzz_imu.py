"""An Imu that is serialized in one step has the bytes of genpy's, whatever its values are."""
import io

import hypothesis.strategies as st
import pytest
from hypothesis import given

pytest.importorskip('rospy')

import rospy  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402

from serial_communication.ros.imu import PackedImu  # noqa: E402

numbers = st.floats(width=64)


def serialized(message):
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def filled(kind, seq, stamp, frame_id, values):
    message = kind()
    message.header.seq, message.header.frame_id = seq, frame_id
    message.header.stamp = rospy.Time(*stamp)
    rest = iter(values)
    for part, names in (('orientation', 'xyzw'), ('angular_velocity', 'xyz'),
                        ('linear_acceleration', 'xyz')):
        for name in names:
            setattr(getattr(message, part), name, next(rest))
    for part in 'orientation', 'angular_velocity', 'linear_acceleration':
        setattr(message, part + '_covariance', [next(rest) for _ in range(9)])
    return message


@given(st.integers(0, 2**32 - 1), st.tuples(st.integers(0, 2**31), st.integers(0, 10**9 - 1)),
       st.text(), st.lists(numbers, min_size=37, max_size=37))
def test_the_bytes_are_those_of_genpy(seq, stamp, frame_id, values):
    fields = seq, stamp, frame_id, values
    assert serialized(filled(PackedImu, *fields)) == serialized(filled(Imu, *fields))
