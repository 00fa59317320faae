"""Bytes <-> frames <-> typed messages. Pure: no I/O, no clock, no thread, no rospy.

Every decoder has the same members: ``feed(data, stamp)`` takes what was read, in whatever chunks
it came, and returns the frames that are complete now; ``pending`` tells whether there are bytes of
which no frame has been returned, ``begun`` whether a frame has begun; ``give_up()`` drops that
beginning and returns what stands behind it, or noise that has ended; ``skip_false_start()`` drops
it only where a valid frame stands behind, and ``front`` and ``needed`` tell when it is time for
that; ``explain(frame)`` tells which bytes of a frame are what. A decoder never raises for what a
line may carry: a bad frame is returned as a `Frame` with a cause, and counted in ``errors`` under
that cause.

Every class of messages has ``TYPE``, ``LABEL`` (its name in words), ``LAYOUT`` (how many bytes of
data it has and what they are), ``unpack(data)``, ``pack()``, ``implausible()`` (why its values
cannot be, or '') and ``parts(data)`` (which bytes are which value); ``str(message)`` is a line for
people. `layout.message_class` makes the simple ones, and `layout.row_methods` gives a class written
by hand what it does not define itself.
"""
