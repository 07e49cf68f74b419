"""Plays datasets back, to ROS 1, ROS 2 or Foxglove."""
