"""Publishers for ROS 1, ROS 2 and Foxglove. Only this package and `recording` import them."""
