"""Where a live run's answers go: autopilot, ROS, Foxglove, plain JSON."""
