"""What rospy does not do well enough for a bridge, mended from outside."""
