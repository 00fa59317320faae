"""All faults at once on real lines, in real time: what the judge in virtual time cannot show.

`scripts/test slow` runs it for ten minutes. It holds the far end of every line itself (lines.py),
and reads what the bridge writes with decoders that share no code with the bridge
(test/helpers/by_definition.py). The boards (boards.py) number what they send. The robot's side
(robot.py) is one ROS node in the same process, so one clock stamps both ends: the time of the
bridge's write where it is known (writes.py), otherwise that of the read. Only the machine
(machine.py) can excuse the bridge. The requirements, and how often each has to be tried in a
minute, are in rows.txt.
"""
