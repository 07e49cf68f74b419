"""Publishers for ROS 1 and ROS 2. Only this package and `recording` import them."""
