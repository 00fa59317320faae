"""Bytes <-> frames <-> typed messages. Pure: no I/O, no clock, no thread, no rospy.

Every decoder has the same members: ``feed(data, stamp)`` takes what was read, in whatever chunks
it came, and returns the frames that are complete now; ``pending`` tells whether a frame has begun
and is not complete; ``give_up()`` drops that beginning and returns what stands behind it;
``doubt()`` does so only where a sound frame stands there, and ``front`` and ``needed`` tell when
it is time for that. A decoder never raises for what a line may carry: a bad frame is returned as
a `Frame` with a cause, and counted in ``errors`` under that cause.
"""
