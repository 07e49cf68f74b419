"""An open dataset: its streams, their frames, its messages, and validation."""
