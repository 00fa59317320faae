"""A sample of a board of another package: a wind sensor. CONTRIBUTING.md explains it.

`baud` is the rate of its port if the parameters have none.
"""
from serial_communication.boards.description import Description, Topic

from . import wire

DESCRIPTION = Description(
    'wind', __name__, lambda sent, parameters: wire.Decoder(),
    topics=(Topic('wind', 'geometry_msgs/Vector3Stamped', 0.2),),
    baud=4800)
