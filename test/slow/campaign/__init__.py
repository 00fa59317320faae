"""The fault campaign on real lines, in real time: checks what is promised in doc/reliability.md.

`scripts/test slow` runs it: one fault at a time on quiet lines, then all at once for ten minutes.

Why its results can be trusted:

The campaign holds the far end of every line itself (lines.py). It reads what the bridge writes with
decoders that share no code with the bridge (test/helpers/by_definition.py). The boards (boards.py)
record what they receive, and number what they send. The robot's side (robot.py) is one ROS node in
the same process, so one clock stamps both ends: the time of the bridge's write where it is known
(writes.py), otherwise that of the read. Only the machine (machine.py) can excuse the bridge. The
requirements, and how often each has to be tried, are in rows.txt.

Before each scenario and each try of the exact part (exact_*.py) `Rig.settle` waits until nothing is
in progress, so all that follows is caused by its event. Every command, call and measurement has a
unique number, so a check compares two lists, or finds that a number did not arrive: a later packet
on the same line proves that. The other part is in storm.py.
"""
