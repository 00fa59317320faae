"""What is known of a running bridge from outside: its topics, its links, and how old each is.

The demo's table, the monitor and the panel all look through this. `topics` says what there is and
puts messages into numbers and words, `state` keeps what has come and judges its age; both know no
ROS. `watcher` fills the state from a master and is the only part that knows rospy.
"""
