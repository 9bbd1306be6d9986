"""Underwater laser vision as a ROS 2 node."""
