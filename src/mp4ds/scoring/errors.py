"""What goes wrong while frames are scored."""

from __future__ import annotations

from mp4ds.errors import Mp4dsError


class ScoringError(Mp4dsError):
    """Frames cannot be scored: libvmaf is missing or failed, or the frames do not match."""
