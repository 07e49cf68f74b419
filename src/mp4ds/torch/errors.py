"""What goes wrong while samples are read."""

from __future__ import annotations

from mp4ds.errors import Mp4dsError


class SampleError(Mp4dsError, RuntimeError):
    """Frames of a sample cannot be read; says of which dataset and topic, and which frame.

    A DataLoader makes an error of a worker again in the main process, from its text alone. So
    this one has nothing but its text, and is the same with and without workers.
    """
