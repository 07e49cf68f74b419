"""Folders of images, and videos of the paper's tool, read as if they were recordings."""
