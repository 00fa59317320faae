"""Patches of rospy, for what it does not do well enough for a bridge."""
