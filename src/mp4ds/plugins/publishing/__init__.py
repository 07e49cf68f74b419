"""Where messages are published. The only package that imports ROS and Foxglove."""
