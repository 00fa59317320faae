"""What all links share: the thread of a port, reconnecting, counters, log. No rospy."""
