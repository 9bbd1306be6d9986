"""Outputs of a live run: autopilot, ROS, Foxglove, plain JSON."""
