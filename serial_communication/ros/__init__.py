"""What the ROS side of all boards shares: parameters, topics, services, tf, diagnostics."""
