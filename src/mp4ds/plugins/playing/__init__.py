"""Plays datasets back, to ROS 1 or ROS 2."""
