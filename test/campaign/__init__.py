"""The fault campaign: each promise of doc/reliability.md, held against a bridge that runs.

How it can be believed:

The campaign holds the far end of every line itself (lines.py): what the bridge writes is read here,
by decoders that share no code with the bridge (test/helpers/by_definition.py). The boards
(boards.py) note what reached them, and say running numbers. The robot's side (robot.py) is one ROS
node in the same process, so one clock stamps both ends of everything.

The exact part (exact.py; scenarios in exact_*.py) has one event at a time. Before each, the line is
known to be quiet (`Field.calm`), so whatever comes afterwards is of this event. Every command, call
and measurement carries a number of its own. So a comparison is an equality of two lists, or "this
number did not come"; and where something must not come, what comes after it on the same line is
waited for, not a time. Times on the car's line are counted in heartbeats, of which the bridge sends
one every 10 ms. Nothing is exempted from any judgement, and no try stays undecided. Where the gaps
between heartbeats are judged while this machine gives ordinary processes no time (one that only
sleeps tells), or where the bridge had to drop bytes as old since it had none, the scenario begins
anew, and the third time that is a violation.

The statistical part (storm.py) has everything at once, and damage on every line. It promises only
what holds whatever the damage was, and counts the rest. There a try may stay undecided: such a gap
between heartbeats, or any for a bridge that may not have real-time priority; a command that crossed
a reconnect. That is a column of the table.

A row of the table (rows.py) is a promise in the words of doc/reliability.md, with its tries, its
violations, what could not be decided, and the worst case.
"""
