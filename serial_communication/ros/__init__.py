"""The ROS side: parameters, topics, services, tf, diagnostics. The only part that knows rospy."""
