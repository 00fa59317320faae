"""One open port each: the reading thread, reconnecting, the session rules, the counters. No rospy."""
