"""A dataset as an HTML report, and its frames as images."""
