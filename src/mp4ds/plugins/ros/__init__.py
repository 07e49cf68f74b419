"""Nodes of ROS 1 and ROS 2. Only this package imports ROS."""
