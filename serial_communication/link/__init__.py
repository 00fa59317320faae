"""What every link has: its port's thread, reconnecting, counters, presence. No rospy."""
