"""ROS 1, ROS 2 or DDS -> dataset, while messages come."""
