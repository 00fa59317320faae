"""One open port each: its reading thread, reconnecting, session rules and counters. No rospy."""
