"""The fault campaign: checks each requirement of doc/reliability.md against a running bridge.

Why its results can be trusted:

The campaign holds the far end of every line itself (lines.py). It reads what the bridge writes with
decoders that share no code with the bridge (test/helpers/by_definition.py). The boards (boards.py)
record what they receive, and number what they send. The robot's side (robot.py) is one ROS node in
the same process, so one clock stamps both ends.

The exact part (exact.py; its scenarios are in exact_*.py) has one event at a time. Before each
event `Rig.settle` waits until nothing is in progress, so all that follows is caused by this event.
Every command, call and measurement has a unique number, so a check compares two lists, or finds
that a number did not arrive: a later packet on the same line proves that, not a timeout. Times on
the car's line are counted in heartbeats, of which the bridge sends one every 10 ms. No check has
exceptions, and none is left undecided (except heartbeat gaps if the system does not allow real-time
priority). If a heartbeat gap or stale bytes may be due to a machine that gave the bridge no
processor time, the scenario is repeated, and the third time that is a violation. A process that
only sleeps detects such times.

The statistical part (storm.py) has all faults at once, and damage on every line. It checks only
what holds for any damage, and counts the rest. The table has a column for checks that cannot be
decided: a heartbeat gap while the machine gave no processor time, or of a bridge without real-time
priority; a command that was published just before a reconnect.

A line of the table (requirements.py) has a requirement in the words of doc/reliability.md, the
number of checks, violations and undecided checks, and the worst case.
"""
