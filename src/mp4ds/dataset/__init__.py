"""A dataset, opened: its streams, their frames, its messages, and whether it is whole."""
