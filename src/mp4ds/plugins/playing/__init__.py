"""Dataset -> ROS 1, ROS 2 or Foxglove, as if it were the recording."""
